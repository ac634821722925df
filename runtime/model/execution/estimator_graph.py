"""Maximum likelihood in ONNX Runtime: constants of a table, a first estimate, and a step that is repeated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import BundleError, InvalidInputError
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import BoundSession, Port, Session, open_session, running
from lightpage.runtime.model.execution.table_graph import GraphFile, HeldTable, check_table

ESTIMATE = ("p", "nuisance", "deviations")
"""State of the estimation, that a step takes and gives."""
BEFORE = {name: f"{name}_before" for name in ESTIMATE}
"""Names of the estimate as a step's input, by that of its output."""
PAGE = ("counts", "reference", "amplitude", "lit")
"""Measurements of a page on the common grid, which all steps share."""
DEVIATION_PRECISION = "deviation_precision"
"""Inverse variance of what the phases of the modulator's samples differ from their symbols'."""
NO_DEVIATIONS = np.array(1e12, np.float32)
"""Precision that keeps them at zero."""
NOISE = "noise"
"""Noise of a number of steps, a row each, from that of the first estimate on."""
EARLY_STEPS = 1
"""Steps whose light may be predicted coarsely: what they err, later ones mend."""
DERIVATIVES = ("by_phase", "by_nuisance", "expected")
ANSWERS = ("p", "phase", "concentration", "nuisance", "deviations")
"""Outputs of the first estimate, and of each step."""
CHI_SQUARE = "chi_square"
"""Output of each step by which a bundle judges its pages."""
STEP_OUTPUTS = (*ANSWERS, CHI_SQUARE, *DERIVATIVES, "by_sample")
RESIDUAL = "residual"
"""Output of the first estimate that no step changes."""
_FRAMES = ("in_phase", "quadrature")


class EstimatorFiles(NamedTuple):
    """Serialised graphs of an estimator.

    Attributes:
        operators: a table to the constants that the others take.
        first: frames to a first estimate.
        early, step: an estimate to the next one, coarsely and exactly.
    """

    operators: bytes
    first: bytes
    early: bytes
    step: bytes


class EstimatorGraph:
    """The graphs of an estimator and their table. It never changes; many threads may call its methods at once.

    Args:
        files: its graphs.
        defaults: graph of all in one, whose inputs have the table's defaults.
        subject: name of the bundle, for errors.
        threads: threads of one run; by default the cores that this process may use.
        table: values instead of the defaults.
        like: the same graphs with another table, whose sessions are shared.
        provider: provider that computes pages; operators are computed on the CPU.
        steps: largest number of steps; None for as many as the bundle has.

    Attributes:
        ports: type and shape of every tensor of the table, by name.
        steps: number of steps.

    Raises:
        InvalidInputError: a table that does not fit.
        BundleError: a graph cannot be run, or lacks what it needs of the table.
        ProviderError: there is no such provider here.
    """

    def __init__(
        self,
        files: EstimatorFiles,
        defaults: GraphFile | HeldTable,
        subject: str,
        threads: int | None,
        table: SamplingTable | None = None,
        like: EstimatorGraph | None = None,
        provider: Provider = ON_CPU,
        steps: int | None = None,
    ) -> None:
        self._files, self._defaults, self._subject = files, defaults, subject
        self._threads, self.provider = threads, provider
        self.ports = defaults.table_inputs
        self.table: SamplingTable = table or {}
        check_table(self.ports, self.table)
        self._limit = steps
        most = most_steps(self.ports, subject)
        self.steps = most if steps is None else min(steps, most)
        if like is None:
            self._device = open_session(files.operators, f"{subject}: operators", threads, once=True)
            self._first, self._early, self._step = (
                open_session(model, f"{subject}: {what}", threads, provider=provider)
                for what, model in {
                    "first estimate": files.first,
                    "early step": files.early,
                    "step": files.step,
                }.items()
            )
        else:
            self._device, self._first, self._early, self._step = like._device, like._first, like._early, like._step
        names = [node.name for node in self._device.get_outputs()]
        feeds = {node.name: self.value(node.name) for node in self._device.get_inputs()}
        with running(subject):
            made = dict(zip(names, self._device.run(names, feeds), strict=True))
        self._held = {name: self.value(name) for name in self.ports if name != NOISE} | made
        self._bound = {session: self._with_constants(session) for session in (self._first, self._early, self._step)}

    def with_table(self, table: SamplingTable) -> EstimatorGraph:
        """The graphs with other tensors in their table, by name; those left out stay. It raises as the constructor."""
        merged = {**self.table, **table}
        files, defaults, threads = self._files, self._defaults, self._threads
        return EstimatorGraph(files, defaults, self._subject, threads, merged, self, self.provider, self._limit)

    @property
    def outputs(self) -> dict[str, Port]:
        """Type and shape of what can be asked for, by name."""
        nodes = (*self._first.get_outputs(), *self._step.get_outputs())
        return {node.name: Port.of(node) for node in nodes}

    @property
    def inputs(self) -> dict[str, Port]:
        """Type and shape of what must be fed with each page, by name."""
        return {node.name: Port.of(node) for node in self._first.get_inputs() if node.name in _FRAMES}

    def value(self, name: str) -> NDArray[Any]:
        """A tensor of the table.

        Raises:
            InvalidInputError: no such tensor.
        """
        if name not in self.ports:
            raise InvalidInputError("table", repr(name), f"one of {sorted(self.ports)}")
        return self.table[name] if name in self.table else self._defaults.default(name)

    def check(self, table: SamplingTable) -> None:
        """Check tensors that are to stand in the table; see `check_table`."""
        check_table(self.ports, table)

    def run(
        self, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]], steps: int | None = None
    ) -> list[NDArray[Any]]:
        """Estimate a page.

        Args:
            outputs: names of what is wanted.
            feeds: frames, and table tensors for this page alone.
            steps: number of steps; the graph's if left out.
        """
        found, steps = self.begun(feeds), self.steps if steps is None else steps
        noise = self.value(NOISE)
        for number in range(steps):
            wanted = (*ANSWERS, CHI_SQUARE) if number == steps - 1 else ESTIMATE
            session = self._early if number < EARLY_STEPS else self._step
            found |= self._stepped(session, found, noise[number + 1], feeds, wanted)
        return [found[name] for name in outputs]

    def run_whole(self, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """Estimate a page with all steps that the bundle has; arguments as for `run`."""
        return self.run(outputs, feeds, len(self.value(NOISE)) - 1)

    def derivatives(
        self,
        page: Mapping[str, NDArray[Any]],
        feeds: Mapping[str, NDArray[Any]],
        p: NDArray[np.float32],
        nuisance: NDArray[np.float32],
        outputs: Sequence[str] = DERIVATIVES,
    ) -> dict[str, NDArray[Any]]:
        """Return outputs of a step from an estimate, by name.

        Args:
            page: measurements of the page and deviations, as `begun` returns them.
            feeds: table tensors for this evaluation alone.
            p, nuisance: the estimate.
            outputs: names of `STEP_OUTPUTS`.
        """
        found = {**page, "p": p, "nuisance": nuisance}
        return self._stepped(self._step, found, self.value(NOISE)[1], feeds, outputs)

    def begun(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the first estimate and the measurements of a page, by name; feeds as for `run`."""
        names = [node.name for node in self._first.get_outputs()]
        return self._asked(self._first, names, {**feeds, NOISE: self.value(NOISE)[0]})

    def _stepped(
        self,
        session: Session,
        found: Mapping[str, NDArray[Any]],
        noise: NDArray[Any],
        feeds: Mapping[str, NDArray[Any]],
        outputs: Sequence[str],
    ) -> dict[str, NDArray[Any]]:
        state = {BEFORE.get(name, name): found[name] for name in (*ESTIMATE, *PAGE)} | {NOISE: noise}
        shared = {name: value for name, value in feeds.items() if name not in _FRAMES}
        return self._asked(session, outputs, {**shared, **state})

    def _asked(
        self, session: Session, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]]
    ) -> dict[str, NDArray[Any]]:
        taken = {node.name for node in session.get_inputs()}
        given = {name: value for name, value in feeds.items() if name in taken}
        return dict(zip(outputs, self._bound[session].run(outputs, given), strict=True))

    def _with_constants(self, session: Session) -> BoundSession:
        """A session with all of the table and the operators that it takes."""
        inputs = {node.name for node in session.get_inputs()}
        held = {name: value for name, value in self._held.items() if name in inputs}
        if missing := inputs - held.keys() - {*_FRAMES, *BEFORE.values(), *PAGE, NOISE}:
            raise BundleError(self._subject, f"graphs that want {', '.join(sorted(missing))}", "inputs of the table")
        return BoundSession(session, self.provider, held, self._subject)


def most_steps(ports: Mapping[str, Port], subject: str) -> int:
    """Number of steps whose noise the table of an estimator holds.

    Args:
        ports: type and shape of every tensor of the table, by name.
        subject: name of the bundle or file, for errors.

    Raises:
        BundleError: the table holds no noise, or that of no step.
    """
    port, wanted = ports.get(NOISE), "float32 [steps + 1, 2], a row for the first estimate and for each step"
    if port is None:
        raise BundleError(f"{subject}: table input {NOISE}", "nothing", wanted)
    rows = port.shape[0] if len(port.shape) == 2 else None
    if port.dtype != "float32" or rows is None or rows < 2 or port.shape[1] != 2:
        raise BundleError(f"{subject}: table input {NOISE}", f"{port.dtype} {list(port.shape)}", wanted)
    return rows - 1
