"""The phase estimator as ONNX graphs: operators of a device, first estimate, step, and all of them in one graph."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn
from torch.utils import _pytree as tree

from lightpage.calibration.likelihood.table import PILOT_MASK, PILOT_PHASORS
from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.export.graph import FRAME_INPUTS, TABLE_INPUTS, answers
from lightpage.export.onnx_files import exported, sharing
from lightpage.export.operators.device_constants import move_device_constants
from lightpage.runtime.model.bundle.manifest import DECODER
from lightpage.runtime.model.execution.estimator_graph import (
    EARLY_STEPS,
    ESTIMATE,
    ESTIMATE_INPUTS,
    ESTIMATE_OUTPUTS,
    NOISE,
    PAGE,
    RESIDUAL,
    STEP_OUTPUTS,
    EstimatorFiles,
)
from lightpage.train.models.likelihood.estimator import (
    OPERATOR_INPUTS,
    Estimate,
    Operators,
    Page,
    PhaseEstimator,
)

PILOTS = (PILOT_PHASORS, PILOT_MASK)
FIRST = (*TABLE_INPUTS, "information", *PILOTS)
"""Tensors of the table that the first estimate of every device takes."""
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
"""Tensors of the table that a step of every device takes."""

_LEAST_SHARED_BYTES = 1_000
"""Least size of a constant that graphs share."""

OF_DEVICE = ("homodyne", "amplitude_series", "slope_power", "point_spread", "deviation_precision", *APART)
"""Tensors of the table that no page has of its own. What follows from them is computed once for each device."""


class OperatorsGraph(nn.Module):
    """Graph from a device's table to its wave operators.

    Args:
        estimator: estimator of the device.

    Attributes:
        structure: tree of the operators' tensors; None before the first call.
    """

    def __init__(self, estimator: PhaseEstimator) -> None:
        super().__init__()
        self.estimator = estimator
        self.structure: tree.TreeSpec | None = None

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Compute the tensors of the operators from those of `OPERATOR_INPUTS`."""
        operators = self.estimator.operators(dict(zip(OPERATOR_INPUTS, tensors, strict=True)))
        leaves, self.structure = tree.tree_flatten(operators)
        return tuple(leaves)


class FirstGraph(nn.Module):
    """Graph from frames to the first estimate and the page's measurements.

    Args:
        estimator: estimator of the device.
        optional: names of the table's tensors that only some devices have.
        structure: tree of the operators' tensors.
        used: indices of the operators' tensors that are inputs.

    Attributes:
        names: names of the table's tensors that are inputs.
    """

    def __init__(
        self, estimator: PhaseEstimator, optional: tuple[str, ...], structure: tree.TreeSpec, used: Sequence[int]
    ) -> None:
        super().__init__()
        self.estimator = estimator
        self._structure = structure
        self._used = tuple(used)
        self.names = (*FIRST, *optional)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Compute `ESTIMATE_OUTPUTS`, `RESIDUAL` and `PAGE` from frames, noise, the table's tensors and operators."""
        in_phase, quadrature, noise = tensors[:3]
        end = 3 + len(self.names)
        table = dict(zip(self.names, tensors[3:end], strict=True))
        operators = restored(self._structure, self._used, tensors[end:])
        estimate, page, residual = self.estimator.first(operators, table, noise, in_phase, quadrature)
        return *answers(estimate.p), estimate.nuisance, estimate.deviations, residual, *page


class StepGraph(nn.Module):
    """Graph from an estimate to the next one.

    Args:
        estimator, structure, used: see `FirstGraph`.
        apart: names of the tensors of cameras in different planes.
        start: whether this is the first step.

    Attributes:
        names: names of the table's tensors that are inputs.
    """

    def __init__(
        self,
        estimator: PhaseEstimator,
        apart: tuple[str, ...],
        structure: tree.TreeSpec,
        used: Sequence[int],
        *,
        start: bool,
    ) -> None:
        super().__init__()
        self.estimator = estimator
        self._apart = apart
        self._structure = structure
        self._used = tuple(used)
        self._start = start
        self.names = (*STEP, *apart)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Compute `STEP_OUTPUTS` from `ESTIMATE`, noise, `PAGE`, the table's tensors and operators."""
        remaining = iter(tensors)
        estimate = Estimate(*islice(remaining, len(ESTIMATE)))
        noise = next(remaining)
        page = Page(*islice(remaining, len(PAGE)))
        table = dict(zip(self.names, islice(remaining, len(self.names)), strict=True))
        operators = restored(self._structure, self._used, [*remaining])
        cameras = self.estimator.recovery.cameras(*(table[name] for name in self._apart))
        coarse = self._start and self.estimator.coarse_start
        likelihood = self.estimator.likelihood(operators, table, page, estimate, cameras, coarse=coarse)
        advanced, chi_square = self.estimator.advanced(table, page, estimate, likelihood, noise, start=self._start)
        return *answers(advanced.p), advanced.nuisance, advanced.deviations, chi_square, *likelihood


class WholeGraph(nn.Module):
    """Graph from frames and table to the estimate after a fixed number of steps.

    Args:
        estimator: estimator of the device.
        optional: names of the table's tensors that only some devices have.
        steps: number of steps.

    Attributes:
        outputs: names of the outputs.
        table_inputs: names of the table's tensors that are inputs.
    """

    outputs = ("p", "phase", "concentration", "residual", "nuisance", "chi_square")

    def __init__(self, estimator: PhaseEstimator, optional: tuple[str, ...], steps: int) -> None:
        super().__init__()
        self.estimator = estimator
        self.steps = steps
        self._apart = apart_of(optional)
        self.table_inputs = tuple(dict.fromkeys((*FIRST, *OPERATOR_INPUTS, *STEP, NOISE, *optional)))

    def forward(self, in_phase: Tensor, quadrature: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Compute `outputs` from frames and `table_inputs`."""
        table = dict(zip(self.table_inputs, tensors, strict=True))
        operators = self.estimator.operators(table)
        cameras = self.estimator.recovery.cameras(*(table[name] for name in self._apart))
        estimate, page, residual = self.estimator.first(operators, table, table[NOISE][0], in_phase, quadrature)
        chi_square = torch.zeros_like(residual)
        for number in range(self.steps):
            start = number < EARLY_STEPS
            coarse = start and self.estimator.coarse_start
            likelihood = self.estimator.likelihood(operators, table, page, estimate, cameras, coarse=coarse)
            noise = table[NOISE][number + 1]
            estimate, chi_square = self.estimator.advanced(table, page, estimate, likelihood, noise, start=start)
        return *answers(estimate.p), residual, estimate.nuisance, chi_square


def apart_of(optional: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the tensors of cameras in different planes."""
    return tuple(name for name in optional if name in APART)


def restored(structure: tree.TreeSpec, used: Sequence[int], tensors: Sequence[Tensor]) -> Operators:
    """Rebuild operators from their tensors.

    Args:
        structure: tree of the operators' tensors.
        used: indices of those that the caller needs; the others become None.
        tensors: tensors at these indices.
    """
    leaves: list[Tensor | None] = [None] * structure.num_leaves
    for index, tensor in zip(used, tensors, strict=True):
        leaves[index] = tensor
    operators: Operators = tree.tree_unflatten(leaves, structure)
    return operators


def estimator_files(
    estimator: PhaseEstimator, frame_dtype: str, optional: tuple[str, ...], table: SamplingTable
) -> EstimatorFiles:
    """Export the graphs of operators, first estimate, early step and step.

    Args:
        estimator: estimator of the device.
        frame_dtype: numpy type of a frame's counts.
        optional: names of the table's tensors that only some devices have.
        table: every tensor of the device.
    """
    apart = apart_of(optional)
    tensors = {name: torch.from_numpy(np.array(value, order="C")) for name, value in table.items()}
    frame = torch.from_numpy(np.zeros(table["reference_in_phase"].shape, frame_dtype))
    device_inputs = tuple(tensors[name] for name in OPERATOR_INPUTS)
    with torch.no_grad():
        device_graph = OperatorsGraph(estimator)
        operators = device_graph(*device_inputs)
        structure = device_graph.structure
        assert structure is not None
        names = tuple(f"operator_{index}" for index in range(len(operators)))
        everything = tuple(range(len(operators)))
        indices = tree.tree_unflatten(list(everything), structure)
        backward = tuple(tree.tree_leaves((indices.backward, indices.illumination)))
        first_graph = FirstGraph(estimator, optional, structure, backward)
        first_inputs = (
            frame,
            frame.clone(),
            tensors[NOISE][0],
            *(tensors[name] for name in first_graph.names),
            *(operators[index] for index in backward),
        )
        first_outputs = (*ESTIMATE_OUTPUTS, RESIDUAL, *PAGE)
        state = dict(zip(first_outputs, first_graph(*first_inputs), strict=True))
    step_inputs = (*(state[name] for name in ESTIMATE), tensors[NOISE][1], *(state[name] for name in PAGE))
    first_names = (*FRAME_INPUTS, NOISE, *first_graph.names, *(names[index] for index in backward))

    def step_model(used: tuple[int, ...], *, start: bool) -> onnx.ModelProto:
        graph = StepGraph(estimator, apart, structure, used, start=start)
        inputs = (*step_inputs, *(tensors[name] for name in graph.names), *(operators[index] for index in used))
        input_names = (*ESTIMATE_INPUTS.values(), NOISE, *PAGE, *graph.names, *(names[index] for index in used))
        return exported(graph, inputs, input_names, STEP_OUTPUTS, None)

    device = exported(device_graph, device_inputs, OPERATOR_INPUTS, names, None)
    first = exported(first_graph, first_inputs, first_names, first_outputs, None)
    early = step_model(backward if estimator.coarse_start else everything, start=True)
    step = step_model(everything, start=False)
    move_device_constants(device, {"first": first, "early": early, "step": step}, {*names, *OF_DEVICE})
    for model in (device, first, early, step):
        onnx.checker.check_model(model)
    return EstimatorFiles(
        operators=device.SerializeToString(),
        first=first.SerializeToString(),
        early=early.SerializeToString(),
        step=step.SerializeToString(),
    )


def whole_onnx(files: EstimatorFiles, steps: int, table: SamplingTable) -> bytes:
    """Join the graphs of operators, first estimate and steps into one, with `table` as the defaults of its inputs.

    Args:
        files: graphs, see `estimator_files`.
        steps: number of steps.
        table: every tensor of the device.

    Returns:
        A serialised model from frames and table to `WholeGraph.outputs`.
    """
    graphs = files.operators, files.first, files.early, files.step
    device, first, early, step = map(onnx.ModelProto.FromString, graphs)
    whole = onnx.ModelProto()
    whole.CopyFrom(first)
    for field in ("node", "initializer", "input", "output", "value_info"):
        whole.graph.ClearField(field)
    _append(whole, device, "", {entry.name: entry.name for entry in device.graph.output})
    names = {entry.name: entry.name for entry in first.graph.output}
    names |= {name: f"{name}_0" for name in (NOISE, RESIDUAL, *ESTIMATE_OUTPUTS)}
    _append(whole, first, "first.", names)
    for number in range(1, steps + 1):
        names = {name: f"{name}_{number}" for name in (NOISE, *STEP_OUTPUTS)}
        names |= {entry: f"{name}_{number - 1}" for name, entry in ESTIMATE_INPUTS.items()}
        if number <= EARLY_STEPS:
            _append(whole, early, f"early{number}.", names)
        else:
            _append(whole, step, f"step{number}.", names)
    node = onnx.helper.make_node
    rows = [f"{NOISE}_row_{number}" for number in range(steps + 1)]
    noise_nodes = [node("Split", [NOISE], rows, axis=0, num_outputs=steps + 1)]
    noise_nodes += [node("Squeeze", [row, "first_axis"], [f"{NOISE}_{number}"]) for number, row in enumerate(rows)]
    whole.graph.initializer.append(numpy_helper.from_array(np.array([0], np.int64), "first_axis"))
    sources = {name: f"{name}_{0 if name == RESIDUAL else steps}" for name in WholeGraph.outputs}
    output_nodes = [node("Identity", [source], [name]) for name, source in sources.items()]
    nodes = [*noise_nodes, *whole.graph.node, *output_nodes]
    whole.graph.ClearField("node")
    whole.graph.node.extend(nodes)
    outputs = {entry.name: entry for model in (first, step) for entry in model.graph.output}
    frames = {entry.name: entry for entry in first.graph.input}
    whole.graph.output.extend(outputs[name] for name in WholeGraph.outputs)
    whole.graph.input.extend(frames[name] for name in FRAME_INPUTS)
    sharing(whole)
    _add_inputs_with_defaults(whole, table)
    onnx.checker.check_model(whole)
    return bytes(whole.SerializeToString())


def with_constants_of(decoder: bytes, graph: bytes) -> bytes:
    """Replace constants of a graph that `decoder.onnx` holds too by references to that file.

    Args:
        decoder: serialised model of `whole_onnx`.
        graph: serialised graph that it was made of.
    """
    model = onnx.ModelProto.FromString(graph)
    for tensor in model.graph.initializer:
        place = decoder.find(tensor.raw_data) if len(tensor.raw_data) >= _LEAST_SHARED_BYTES else -1
        if place >= 0:
            onnx.external_data_helper.set_external_data(tensor, DECODER, place, len(tensor.raw_data))
            tensor.ClearField("raw_data")
    return bytes(model.SerializeToString())


def _append(whole: onnx.ModelProto, part: onnx.ModelProto, prefix: str, names: dict[str, str]) -> None:
    """Append the nodes of one graph to another.

    Args:
        whole: graph that grows.
        part: graph that is appended.
        prefix: prefix in `whole` of the tensors that nodes of `part` compute. Parts that differ only in the number at
            its end share their initializers.
        names: names in `whole` of the part's inputs and outputs. Inputs that are not listed keep their names.
    """
    title = prefix.rstrip("0123456789.") or "operators"
    present = {tensor.name for tensor in whole.graph.initializer}
    inputs = {entry.name for entry in part.graph.input}
    initializers = {tensor.name: f"{title}.{tensor.name}" for tensor in part.graph.initializer}
    for tensor in part.graph.initializer:
        if initializers[tensor.name] not in present:
            copied = whole.graph.initializer.add()
            copied.CopyFrom(tensor)
            copied.name = initializers[tensor.name]
        if tensor.name in names:  # an output that no node computes, since it is constant
            constant = onnx.helper.make_node("Identity", [initializers[tensor.name]], [names[tensor.name]])
            whole.graph.node.append(constant)

    def renamed(name: str) -> str:
        if not name:  # an optional input that is left out
            return name
        if name in names:
            return names[name]
        if name in initializers:
            return initializers[name]
        return name if name in inputs else prefix + name

    for node in part.graph.node:
        copy = whole.graph.node.add()
        copy.CopyFrom(node)
        copy.name = prefix + node.name
        copy.input[:] = map(renamed, node.input)
        copy.output[:] = map(renamed, node.output)


def _add_inputs_with_defaults(model: onnx.ModelProto, table: SamplingTable) -> None:
    """Add an input with a default for each tensor of a table, including tensors that no node uses."""
    for name, value in table.items():
        array: NDArray[np.generic] = np.array(value, order="C")
        element_type = onnx.helper.np_dtype_to_tensor_dtype(array.dtype)
        model.graph.initializer.append(numpy_helper.from_array(array, name))
        model.graph.input.append(onnx.helper.make_tensor_value_info(name, element_type, array.shape))
