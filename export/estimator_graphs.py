"""The phase estimator as graphs: constants of a device's table, a first estimate, one step, and all in one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn
from torch.utils import _pytree as tree

from lightpage.calibration.likelihood.table import PILOT_MASK, PILOT_PHASORS
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.export.graph import FRAME_INPUTS, TABLE_INPUTS, answers
from lightpage.export.onnx_files import exported
from lightpage.runtime.model.execution.estimator_graph import (
    ANSWERS,
    BEFORE,
    EARLY_STEPS,
    ESTIMATE,
    NOISE,
    PAGE,
    RESIDUAL,
    STEP_OUTPUTS,
    EstimatorFiles,
)
from lightpage.train.models.likelihood.estimator import Estimate, Operators, Page, PhaseEstimator

DEVICE = ("parameters", "blur", "illumination")
"""Inputs that the wave operators follow from."""
PILOTS = (PILOT_PHASORS, PILOT_MASK)
FIRST = (*TABLE_INPUTS, "information", *PILOTS)
"""Inputs of the first estimate beside frames, its noise, cameras that stand apart, and operators."""
COUNTS = ("amplitude_series", "slope_power", "count_scale", "count_weights")
STEP = (
    "homodyne",
    *COUNTS,
    "information",
    "point_spread",
    "deviation_precision",
    "responses",
    "nuisance_covariance",
    "nuisance_precision",
    *PILOTS,
)
"""Inputs of a step beside the page, the estimate, its noise, cameras that stand apart, and operators."""


class OperatorsGraph(nn.Module):
    """A device's table to its wave operators.

    Args:
        estimator: of the device.
    """

    def __init__(self, estimator: PhaseEstimator) -> None:
        super().__init__()
        self.estimator = estimator
        self.structure: tree.TreeSpec | None = None
        """Structure of the operators, known once they were computed."""

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """`DEVICE` to the tensors of the operators."""
        made = self.estimator.operators(dict(zip(DEVICE, tensors, strict=True)))
        flat, self.structure = tree.tree_flatten(made)
        return tuple(flat)


class FirstGraph(nn.Module):
    """Frames to the first estimate and the page.

    Args:
        estimator: of the device.
        apart: names of the tensors of cameras that stand apart.
        structure: of the operators.
        used: numbers of the operators' tensors that are inputs.
    """

    def __init__(
        self, estimator: PhaseEstimator, apart: tuple[str, ...], structure: tree.TreeSpec, used: Sequence[int]
    ) -> None:
        super().__init__()
        self.estimator, self._structure, self._used = estimator, structure, tuple(used)
        self.names = (*FIRST, *apart)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Frames, noise, `names` and operators to p, phase, concentration, nuisance, deviations, residual and page."""
        frames, noise, given = tensors[:2], tensors[2], 3 + len(self.names)
        table = dict(zip(self.names, tensors[3:given], strict=True))
        operators = restored(self._structure, self._used, tensors[given:])
        estimate, page, residual = self.estimator.first(operators, table, noise, *frames)
        return *answers(estimate.p), estimate.nuisance, estimate.deviations, residual, *page


class StepGraph(nn.Module):
    """An estimate to the next one.

    Args:
        estimator, apart, structure, used: see `FirstGraph`.
        coarse: see `PhaseEstimator.likelihood`.
    """

    def __init__(
        self,
        estimator: PhaseEstimator,
        apart: tuple[str, ...],
        structure: tree.TreeSpec,
        used: Sequence[int],
        *,
        coarse: bool,
    ) -> None:
        super().__init__()
        self.estimator, self._apart, self._structure, self._used = estimator, apart, structure, tuple(used)
        self._coarse = coarse
        self.names = (*STEP, *apart)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Estimate, noise, page, `names` and operators to p, phase, concentration, nuisance, deviations, chi-square.

        Beside them come the derivatives of the log-likelihood at the estimate that was given, and its expected counts.
        """
        state = len(ESTIMATE) + 1
        estimate, noise = Estimate(*tensors[: state - 1]), tensors[state - 1]
        page = Page(*tensors[state : state + len(PAGE)])
        given = state + len(PAGE)
        table = dict(zip(self.names, tensors[given : given + len(self.names)], strict=True))
        operators = restored(self._structure, self._used, tensors[given + len(self.names) :])
        cameras = self.estimator.recovery.cameras(*(table[name] for name in self._apart))
        found = self.estimator.likelihood(operators, table, page, estimate, cameras, coarse=self._coarse)
        after, chi_square = self.estimator.advanced(table, page, estimate, found, noise, coarse=self._coarse)
        return *answers(after.p), after.nuisance, after.deviations, chi_square, *found


class WholeGraph(nn.Module):
    """Frames and table to the estimate after a fixed number of steps.

    Args:
        estimator, apart: see `FirstGraph`.
        steps: number of steps.
    """

    outputs = ("p", "phase", "concentration", "residual", "nuisance", "chi_square")

    def __init__(self, estimator: PhaseEstimator, apart: tuple[str, ...], steps: int) -> None:
        super().__init__()
        self.estimator, self.steps, self._apart = estimator, steps, apart
        self.table_inputs = tuple(dict.fromkeys((*FIRST, *DEVICE, *STEP, NOISE, *apart)))

    def forward(self, in_phase: Tensor, quadrature: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Frames and `table_inputs` to `outputs`."""
        table = dict(zip(self.table_inputs, tensors, strict=True))
        operators = self.estimator.operators(table)
        cameras = self.estimator.recovery.cameras(*(table[name] for name in self._apart))
        estimate, page, residual = self.estimator.first(operators, table, table[NOISE][0], in_phase, quadrature)
        chi_square = torch.zeros_like(residual)
        for number in range(self.steps):
            coarse = number < EARLY_STEPS
            found = self.estimator.likelihood(operators, table, page, estimate, cameras, coarse=coarse)
            noise = table[NOISE][number + 1]
            estimate, chi_square = self.estimator.advanced(table, page, estimate, found, noise, coarse=coarse)
        return *answers(estimate.p), residual, estimate.nuisance, chi_square


def restored(structure: tree.TreeSpec, used: Sequence[int], tensors: Sequence[Tensor]) -> Operators:
    """Operators of those of their tensors that are there; the others are not looked at."""
    whole: list[Tensor | None] = [None] * structure.num_leaves
    for number, tensor in zip(used, tensors, strict=True):
        whole[number] = tensor
    operators: Operators = tree.tree_unflatten(whole, structure)
    return operators


def estimator_files(
    estimator: PhaseEstimator, frame_dtype: str, apart: tuple[str, ...], table: SamplingTable
) -> EstimatorFiles:
    """Export the graphs of operators, first estimate, early step and step.

    Args:
        estimator: estimator of the device.
        frame_dtype: type of a frame's counts.
        apart: names of the tensors of cameras that stand apart.
        table: every tensor of the device.
    """
    tensors = {name: torch.from_numpy(np.array(value, order="C")) for name, value in table.items()}
    frame = torch.from_numpy(np.zeros(table["reference_in_phase"].shape, frame_dtype))
    frames = frame, frame.clone()
    with torch.no_grad():
        device = OperatorsGraph(estimator)
        flat = device(*(tensors[name] for name in DEVICE))
        structure = device.structure
        assert structure is not None
        names = [f"operator_{number}" for number in range(len(flat))]
        numbered = tree.tree_unflatten(list(range(len(flat))), structure)
        backward = tree.tree_flatten((numbered.backward, numbered.illumination))[0]
        everything = tuple(range(len(flat)))
        first = FirstGraph(estimator, apart, structure, backward)
        asked = (
            *frames,
            tensors[NOISE][0],
            *(tensors[name] for name in first.names),
            *(flat[number] for number in backward),
        )
        begun = first(*asked)
        steps = {
            numbers: StepGraph(estimator, apart, structure, numbers, coarse=numbers != everything)
            for numbers in (tuple(backward), everything)
        }
    outputs = [*ANSWERS, RESIDUAL, *PAGE]
    made = dict(zip(outputs, begun, strict=True))
    given = (*(made[name] for name in ESTIMATE), tensors[NOISE][1], *(made[name] for name in PAGE))
    files = [
        exported(device, tuple(tensors[name] for name in DEVICE), DEVICE, tuple(names), None),
        exported(
            first,
            asked,
            (*FRAME_INPUTS, NOISE, *first.names, *(names[number] for number in backward)),
            tuple(outputs),
            None,
        ),
        *(
            exported(
                step,
                (*given, *(tensors[name] for name in step.names), *(flat[number] for number in numbers)),
                (*BEFORE.values(), NOISE, *PAGE, *step.names, *(names[number] for number in numbers)),
                STEP_OUTPUTS,
                None,
            )
            for numbers, step in steps.items()
        ),
    ]
    for file in files:
        onnx.checker.check_model(file)
    return EstimatorFiles(*(bytes(file.SerializeToString()) for file in files))


def whole_onnx(files: EstimatorFiles, steps: int, table: SamplingTable) -> bytes:
    """Join the graphs of operators, first estimate and step to one, with `table` as the defaults of its inputs.

    Args:
        files: of `estimator_files`.
        steps: number of steps.
        table: every tensor of the device.

    Returns:
        A serialised model from frames and table to `WholeGraph.outputs`.
    """
    device, first, early, step = (onnx.ModelProto.FromString(file) for file in files)
    whole = onnx.ModelProto()
    whole.CopyFrom(first)
    for field in ("node", "initializer", "input", "output", "value_info"):
        whole.graph.ClearField(field)
    inputs = {entry.name: entry for model in (device, first, early, step) for entry in model.graph.input}
    _append(whole, device, "", {entry.name: entry.name for entry in device.graph.output})
    kept = {entry.name: entry.name for entry in first.graph.output}
    kept |= {NOISE: f"{NOISE}_0", RESIDUAL: f"{RESIDUAL}_0"}
    kept |= {name: f"{name}_0" for name in ANSWERS}
    _append(whole, first, "first.", kept)
    for number in range(1, steps + 1):
        kept = {name: f"{name}_{number}" for name in (NOISE, *STEP_OUTPUTS)}
        kept |= {entry: f"{name}_{number - 1}" for name, entry in BEFORE.items()}
        part, title = (early, "early") if number <= EARLY_STEPS else (step, "step")
        _append(whole, part, f"{title}{number}.", kept)
    make = onnx.helper.make_node
    rows = [f"{NOISE}_row_{number}" for number in range(steps + 1)]
    split = [make("Split", [NOISE], rows, axis=0, num_outputs=steps + 1)]
    split += [make("Squeeze", [row, "first_axis"], [f"{NOISE}_{number}"]) for number, row in enumerate(rows)]
    whole.graph.initializer.append(numpy_helper.from_array(np.array([0], np.int64), "first_axis"))
    last = {name: f"{name}_{0 if name == RESIDUAL else steps}" for name in WholeGraph.outputs}
    nodes = [*split, *whole.graph.node, *(make("Identity", [source], [name]) for name, source in last.items())]
    whole.graph.ClearField("node")
    whole.graph.node.extend(nodes)
    known = {entry.name: entry for model in (first, step) for entry in model.graph.output}
    whole.graph.output.extend(known[name] for name in WholeGraph.outputs)
    whole.graph.input.extend(inputs[name] for name in FRAME_INPUTS)
    _with_defaults(whole, table)
    onnx.checker.check_model(whole)
    return bytes(whole.SerializeToString())


def _append(whole: onnx.ModelProto, part: onnx.ModelProto, prefix: str, kept: dict[str, str]) -> None:
    """Append the nodes of a graph to another one.

    Args:
        whole, part: both graphs.
        prefix: prefix of the names of tensors that nodes of the part compute.
        kept: names of tensors in `whole`, by those in the part; inputs that are not there keep their names.
    """
    title = prefix.rstrip("0123456789.") or "operators"
    present = {held.name for held in whole.graph.initializer}
    inputs = {entry.name for entry in part.graph.input}
    # an output may be a constant, as the deviations of a first estimate are
    renamed = {held.name: kept.get(held.name, f"{title}.{held.name}") for held in part.graph.initializer}
    for held in part.graph.initializer:
        if renamed[held.name] not in present:
            whole.graph.initializer.add().CopyFrom(held)
            whole.graph.initializer[-1].name = renamed[held.name]

    def name_of(name: str) -> str:
        if not name or name in kept:
            return kept.get(name, name)
        return renamed.get(name, name if name in inputs else prefix + name)

    for node in part.graph.node:
        copy = whole.graph.node.add()
        copy.CopyFrom(node)
        copy.name = prefix + node.name
        copy.input[:] = map(name_of, node.input)
        copy.output[:] = map(name_of, node.output)


def _with_defaults(model: onnx.ModelProto, table: SamplingTable) -> None:
    """Give a graph an input with a default for each tensor of a table, be it used or not."""
    for name, value in table.items():
        array: NDArray[np.generic] = np.array(value, order="C")
        kind = onnx.helper.np_dtype_to_tensor_dtype(array.dtype)
        model.graph.initializer.append(numpy_helper.from_array(array, name))
        model.graph.input.append(onnx.helper.make_tensor_value_info(name, kind, array.shape))
