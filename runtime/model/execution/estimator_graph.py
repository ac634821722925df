"""Maximum likelihood in ONNX Runtime: operators of a device, a first estimate of a page, and repeated steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import BundleError, InvalidInputError
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import BoundSession, Port, Session, open_session, running
from lightpage.runtime.model.execution.step_times import StepTimes
from lightpage.runtime.model.execution.table_graph import GraphFile, HeldTable, check_table, with_outputs

ESTIMATE = ("p", "nuisance", "deviations")
"""Outputs of the first estimate and of each step that the next step takes."""
ESTIMATE_INPUTS = {name: f"{name}_before" for name in ESTIMATE}
"""Names of the same tensors as a step's inputs, by their names as outputs."""
PAGE = ("counts", "reference", "amplitude", "lit")
"""Measurements of a page on the common grid: outputs of the first estimate that every step takes."""
DEVIATION_PRECISION = "deviation_precision"
"""Inverse variance of the deviations of the modulator's samples from the phases of their symbols."""
NO_DEVIATIONS = np.array(1e12, np.float32)
"""Precision that keeps the deviations at zero."""
NUISANCE_COVARIANCE = "nuisance_covariance"
"""Covariance of a page's brightness, tilt and shift after a step."""
NOISE = "noise"
"""Noise of the first estimate and after each step, one row each."""
EARLY_STEPS = 1
"""Number of first steps that leave the deviations at zero. In bright light they predict the light coarsely, and later
steps correct their errors."""
EXPECTED = "expected"
"""Output of a step: expected counts of both cameras at the estimate it was given."""
DERIVATIVES = ("by_phase", "by_nuisance", EXPECTED)
"""Outputs of a step that belong to the estimate it was given."""
ESTIMATE_OUTPUTS = ("p", "phase", "concentration", "nuisance", "deviations")
"""Outputs of the first estimate and of each step."""
CHI_SQUARE = "chi_square"
"""Output of a step: mean square of the counts' residuals over their variance, at the estimate it was given."""
STEP_OUTPUTS = (*ESTIMATE_OUTPUTS, CHI_SQUARE, *DERIVATIVES, "by_sample")
RESIDUAL = "residual"
"""Output of the first estimate that steps do not change."""
_FRAMES = ("in_phase", "quadrature")


class EstimatorFiles(NamedTuple):
    """Serialised graphs of an estimator.

    Attributes:
        operators: graph from a device's table to the wave operators, which the other graphs take.
        first: graph from frames to the first estimate.
        early: graph from the first estimate to that after the first step.
        step: graph from an estimate to the next one.
        constants: contents of files that the graphs share constants with, by name.
    """

    operators: bytes
    first: bytes
    early: bytes
    step: bytes
    constants: Mapping[str, bytes] = MappingProxyType({})


class _OpenedOnce:
    """Session that is opened when it is first needed, for all graphs that share it.

    Args:
        open_it: opens the session.
    """

    def __init__(self, open_it: Callable[[], Session]) -> None:
        self._open_it = open_it

    @cached_property
    def session(self) -> Session:
        """The session."""
        return self._open_it()


class EstimatorGraph:
    """The graphs of an estimator with their table.

    It is immutable, apart from the times that it measures. Several threads may call its methods at the same time.

    Args:
        files: serialised graphs.
        defaults: defaults of the table's tensors.
        subject: name of the bundle, for errors.
        threads: threads of one run; by default the cores that this process may use.
        table: tensors that replace their defaults, by name.
        like: the same graphs with another table, whose sessions are shared.
        provider: execution provider of the pages' graphs; operators are computed on the CPU.
        steps: largest number of steps; the number that the bundle has if left out.

    Attributes:
        ports: type and shape of every tensor of the table, by name.
        table: tensors that replace their defaults, by name.
        provider: execution provider of the pages' graphs.
        most_steps: number of steps that the bundle has.
        steps: number of steps that a page gets.
        times: times of the first estimate and of steps; graphs with another table share them.

    Raises:
        InvalidInputError: a tensor of `table` has an unknown name, a wrong type or shape, or values that are not
            finite.
        BundleError: a graph cannot be run, or takes an input that the table does not have.
        ProviderError: this machine does not have the provider.
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
        self._files = files
        self._defaults = defaults
        self._subject = subject
        self._threads = threads
        self.provider = provider
        self.ports = defaults.table_inputs
        self.table: SamplingTable = table or {}
        check_table(self.ports, self.table)
        self._limit = steps
        self.times: StepTimes = StepTimes(EARLY_STEPS) if like is None else like.times
        self.most_steps = most_steps(self.ports, subject)
        self.steps = self.most_steps if steps is None else min(steps, self.most_steps)
        if like is None:
            held = files.constants
            self._operators = open_session(files.operators, f"{subject}: operators", threads, once=True, constants=held)
            of_pages = partial(open_session, threads=threads, provider=provider, constants=held)
            self._first = of_pages(files.first, f"{subject}: first estimate")
            self._early = of_pages(files.early, f"{subject}: early step")
            self._step = of_pages(files.step, f"{subject}: step")
            self._prediction = _OpenedOnce(lambda: of_pages(with_outputs(files.step, [EXPECTED]), f"{subject}: step"))
        else:
            self._operators = like._operators
            self._first = like._first
            self._early = like._early
            self._step = like._step
            self._prediction = like._prediction
        if like is None:
            self._values = {**defaults.defaults(self.ports.keys() - self.table.keys()), **self.table}
        else:
            self._values = {**like._values, **self.table}
        self._constants: SamplingTable
        self._bound: dict[Session, BoundSession]
        if like is not None and _same_but_noise(self.table, like.table):
            self._constants = like._constants
            self._bound = like._bound
            return
        names = [node.name for node in self._operators.get_outputs()]
        feeds = {node.name: self.value(node.name) for node in self._operators.get_inputs()}
        with running(subject):
            operators = dict(zip(names, self._operators.run(names, feeds), strict=True))
        self._constants = {name: self.value(name) for name in self.ports if name != NOISE} | operators
        self._bound = {session: self._with_constants(session) for session in (self._first, self._early, self._step)}

    def with_table(self, table: SamplingTable) -> EstimatorGraph:
        """Return the graphs with replaced tensors in their table.

        Args:
            table: new tensors, by name; the others stay.

        Raises:
            InvalidInputError, BundleError: see the constructor.
        """
        return EstimatorGraph(
            self._files,
            self._defaults,
            self._subject,
            self._threads,
            {**self.table, **table},
            like=self,
            provider=self.provider,
            steps=self._limit,
        )

    @property
    def outputs(self) -> dict[str, Port]:
        """Types and shapes of the outputs of the first estimate and of the steps, by name."""
        nodes = (*self._first.get_outputs(), *self._step.get_outputs())
        return {node.name: Port.of(node) for node in nodes}

    @property
    def inputs(self) -> dict[str, Port]:
        """Types and shapes of the frames that each page needs, by name."""
        return {node.name: Port.of(node) for node in self._first.get_inputs() if node.name in _FRAMES}

    def value(self, name: str) -> NDArray[Any]:
        """A tensor of the table.

        Raises:
            InvalidInputError: no such tensor.
        """
        if name not in self.ports:
            raise InvalidInputError("table", repr(name), f"one of {sorted(self.ports)}")
        return self._values[name]

    def check(self, table: SamplingTable) -> None:
        """Check new tensors of the table; see `check_table`."""
        check_table(self.ports, table)

    def run(
        self, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]], steps: int | None = None
    ) -> list[NDArray[Any]]:
        """Estimate a page.

        Args:
            outputs: names of outputs. `chi_square` needs at least one step.
            feeds: frames, and tensors of the table for this page alone, by name.
            steps: number of steps; `self.steps` if left out.
        """
        steps = self.steps if steps is None else steps
        with self.times.measured(0):
            state = self.first_estimate(feeds)
        for number in range(1, steps + 1):
            wanted = (*ESTIMATE_OUTPUTS, CHI_SQUARE) if number == steps else ESTIMATE
            with self.times.measured(number):
                state = self.step(state, feeds, number, wanted)
        return [state[name] for name in outputs]

    def step(
        self,
        state: Mapping[str, NDArray[Any]],
        feeds: Mapping[str, NDArray[Any]],
        number: int,
        outputs: Sequence[str] = ESTIMATE,
    ) -> dict[str, NDArray[Any]]:
        """Compute a step of a page.

        Args:
            state: outputs of the first estimate and of the steps before, by name.
            feeds: see `run`.
            number: number of the step, 1 or more.
            outputs: names from `STEP_OUTPUTS`; the next step needs those of `ESTIMATE`.

        Returns:
            The state after the step.
        """
        session = self._early if number <= EARLY_STEPS else self._step
        return {**state, **self._run_step(session, state, self.value(NOISE)[number], feeds, outputs)}

    def run_whole(self, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """Estimate a page with all steps of the bundle, whatever `self.steps` is; see `run`."""
        return self.run(outputs, feeds, self.most_steps)

    def derivatives(
        self,
        page: Mapping[str, NDArray[Any]],
        feeds: Mapping[str, NDArray[Any]],
        p: NDArray[np.float32],
        nuisance: NDArray[np.float32],
        outputs: Sequence[str] = DERIVATIVES,
    ) -> dict[str, NDArray[Any]]:
        """Evaluate a step at an estimate. Expected counts alone are computed without the rest of the step.

        Args:
            page: measurements of the page and deviations, see `first_estimate`.
            feeds: tensors of the table for this evaluation alone, by name.
            p: phases and concentrations of the symbols, [2, ny, nx].
            nuisance: nuisance parameters of the page, [6].
            outputs: names from `STEP_OUTPUTS`.

        Returns:
            The outputs by name.
        """
        state = {**page, "p": p, "nuisance": nuisance}
        session = self._step
        if [*outputs] == [EXPECTED]:
            session = self._prediction.session
            if session not in self._bound:
                self._bound[session] = self._with_constants(session)
        return self._run_step(session, state, self.value(NOISE)[1], feeds, outputs)

    def first_estimate(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Compute the first estimate of a page.

        Args:
            feeds: see `run`.

        Returns:
            `ESTIMATE_OUTPUTS`, `RESIDUAL`, and the page's measurements (`PAGE`), by name.
        """
        names = [node.name for node in self._first.get_outputs()]
        return self._run_session(self._first, names, {**feeds, NOISE: self.value(NOISE)[0]})

    def _run_step(
        self,
        session: Session,
        state: Mapping[str, NDArray[Any]],
        noise: NDArray[Any],
        feeds: Mapping[str, NDArray[Any]],
        outputs: Sequence[str],
    ) -> dict[str, NDArray[Any]]:
        table = {name: value for name, value in feeds.items() if name not in _FRAMES}
        inputs = {ESTIMATE_INPUTS.get(name, name): state[name] for name in (*ESTIMATE, *PAGE)}
        return self._run_session(session, outputs, {**table, **inputs, NOISE: noise})

    def _run_session(
        self, session: Session, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]]
    ) -> dict[str, NDArray[Any]]:
        inputs = {node.name for node in session.get_inputs()}
        used = {name: value for name, value in feeds.items() if name in inputs}
        return dict(zip(outputs, self._bound[session].run(outputs, used), strict=True))

    def _with_constants(self, session: Session) -> BoundSession:
        """Bind the tensors of the table and the operators that a session takes."""
        inputs = {node.name for node in session.get_inputs()}
        constants = {name: value for name, value in self._constants.items() if name in inputs}
        if missing := inputs - constants.keys() - {*_FRAMES, *ESTIMATE_INPUTS.values(), *PAGE, NOISE}:
            raise BundleError(self._subject, f"graphs that want {', '.join(sorted(missing))}", "inputs of the table")
        return BoundSession(session, self.provider, constants, self._subject)


def _same_but_noise(one: SamplingTable, other: SamplingTable) -> bool:
    """Return whether two tables hold the same arrays, apart from the noise, from which no constant follows."""
    names = (one.keys() | other.keys()) - {NOISE}
    return all(one.get(name) is other.get(name) for name in names)


def most_steps(ports: Mapping[str, Port], subject: str) -> int:
    """Return the number of steps for which an estimator's table has noise.

    Args:
        ports: type and shape of every tensor of the table, by name.
        subject: name of the bundle or file, for errors.

    Raises:
        BundleError: the table has no noise, noise of another type or shape, or noise of no step.
    """
    port = ports.get(NOISE)
    wanted = "float32 [steps + 1, 2], a row for the first estimate and for each step"
    if port is None:
        raise BundleError(f"{subject}: table input {NOISE}", "nothing", wanted)
    rows = port.shape[0] if len(port.shape) == 2 else None
    if port.dtype != "float32" or rows is None or rows < 2 or port.shape[1] != 2:
        raise BundleError(f"{subject}: table input {NOISE}", f"{port.dtype} {list(port.shape)}", wanted)
    return rows - 1
