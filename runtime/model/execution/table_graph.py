"""A decoder's graph cut in two: what follows from the table alone is computed once, the rest for every page.

ONNX Runtime would fold constants by itself, but not defaults of inputs that may be fed; and it holds all that it has
folded on the way until it is done, which for a page of the full size is ten gigabytes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import BundleError, InvalidInputError
from lightpage.runtime.model.execution.pb.lightpage.onnx import graph_pb2 as pb
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import BoundSession, Port, Session, open_session, running
from lightpage.runtime.model.execution.step_times import StepTimes

_DTYPES = {1: "float32", 2: "uint8", 4: "uint16", 6: "int32", 7: "int64", 10: "float16", 11: "float64"}
"""numpy's names of ONNX's element types."""
_NUMBERS = {name: number for number, name in _DTYPES.items()} | {"bool": 9}
_LISTS = {"float32": "float_data", "int64": "int64_data", "float64": "double_data"}
"""Where values lie that are not stored as bytes, by type; those of all other types share a list."""
_DEFAULTS_FROM = 4
"""Version of ONNX's representation from which an input may have a default; before, weights are listed as inputs too."""


@dataclass(frozen=True)
class CutGraph:
    """A graph in two parts.

    Attributes:
        before: computes `between` and takes nothing; None where there is nothing to compute.
        behind: takes frames, what is still fed, `between` and `direct`.
        between: names of tensors.
        direct: names of the table's tensors that the second part takes as they are.
    """

    before: bytes | None
    behind: pb.Model
    between: tuple[str, ...]
    direct: tuple[str, ...]

    def behind_with(self, values: Mapping[str, NDArray[np.generic]]) -> bytes:
        """The second part, that takes tensors of the types and shapes of these values of `between` and `direct`."""
        model = pb.Model()
        model.CopyFrom(self.behind)
        for name in (*self.between, *self.direct):
            described = model.graph.input.add(name=name).type.tensor_type
            described.elem_type = _NUMBERS[str(values[name].dtype)]
            described.shape.SetInParent()
            for size in values[name].shape:
                described.shape.dim.add(dim_value=size)
        return model.SerializeToString()


class GraphFile:
    """The bytes of an ONNX file, so far as its inputs and their defaults are concerned.

    Args:
        model: the serialised model.
        subject: what it is, for the error.

    Attributes:
        table_inputs: inputs that have a default, by name, of its type and shape.

    Raises:
        BundleError: the bytes are no ONNX model.
    """

    def __init__(self, model: bytes, subject: str) -> None:
        self._model = model
        expected = "an ONNX model of a Lightpage bundle"
        try:
            whole = pb.Model.FromString(model)
        except DecodeError as error:
            raise BundleError(subject, error, expected) from None
        if not whole.HasField("graph"):
            raise BundleError(subject, "no graph", expected)
        fed = {entry.name for entry in whole.graph.input} if whole.ir_version >= _DEFAULTS_FROM else set()
        self.table_inputs = {
            tensor.name: Port(_DTYPES.get(tensor.data_type, str(tensor.data_type)), tuple(tensor.dims))
            for tensor in whole.graph.initializer
            if tensor.name in fed
        }

    def default(self, name: str) -> NDArray[np.generic]:
        """The default of a table input, read-only.

        Args:
            name: one of `table_inputs`.
        """
        return self.defaults([name])[name]

    def defaults(self, names: Collection[str]) -> dict[str, NDArray[np.generic]]:
        """Defaults of some table inputs, read-only, by name."""
        values: dict[str, NDArray[np.generic]] = {}
        for tensor in pb.Model.FromString(self._model).graph.initializer:
            if tensor.name not in names:
                continue
            dtype = np.dtype(self.table_inputs[tensor.name].dtype)
            if tensor.raw_data:
                array = np.frombuffer(tensor.raw_data, dtype.newbyteorder("<")).astype(dtype, copy=False)
            else:
                array = np.array(getattr(tensor, _LISTS.get(dtype.name, "int32_data")), dtype)
            values[tensor.name] = array.reshape([int(size) for size in tensor.dims])
        return values

    def cut(self, table: SamplingTable, fed: Collection[str]) -> CutGraph:
        """The model without table inputs but those `fed`, in two parts.

        Args:
            table: values instead of the defaults, of their types and shapes.
            fed: names of table inputs that stay inputs, and have no default any more.
        """
        model = pb.Model.FromString(self._model)
        graph, fixed = model.graph, self.table_inputs.keys() - set(fed)
        inputs = [entry for entry in graph.input if entry.name not in fixed]
        held = [tensor for tensor in graph.initializer if tensor.name not in self.table_inputs.keys() - fixed]
        _replace(graph, input=inputs, initializer=held)
        for tensor in graph.initializer:
            if tensor.name in table and tensor.name in fixed:
                for field in ("float_data", "int32_data", "int64_data", "double_data", "uint64_data"):
                    tensor.ClearField(field)
                value = np.asarray(table[tensor.name])
                tensor.raw_data = value.astype(value.dtype.newbyteorder("<")).tobytes()
        return _cut(model, fixed)


def _cut(model: pb.Model, fixed: Collection[str]) -> CutGraph:
    """Nodes that depend on initializers alone, some of `fixed` among them, before all others."""
    graph = model.graph
    inner = any(attribute.g or attribute.graphs for node in graph.node for attribute in node.attribute)
    wanted, varying, derived = {value.name for value in graph.output}, {entry.name for entry in graph.input}, set(fixed)
    before, behind = [], []
    for node in graph.node:
        if not inner and not varying.intersection(node.input) and derived.intersection(node.input):
            derived.update(node.output)
            before.append(node)
        else:  # what depends on neither is small, and the runtime folds it; inner graphs see tensors without saying so
            varying.update(node.output if varying.intersection(node.input) else ())
            behind.append(node)
    computed = {name for node in before for name in node.output}
    taken = {name for node in behind for name in node.input} | wanted
    between, direct = tuple(sorted(computed & taken)), tuple(sorted(taken.intersection(fixed) if not inner else ()))
    first = None
    if between:
        first = pb.Model()
        first.CopyFrom(model)
        constants = {name for node in before for name in node.input}
        # what neither part alone depends on is made in both
        _keep(first, [*_needed(behind, constants - computed), *before], (), ())
        types = {value.name: value for value in graph.value_info}
        first.graph.output.extend(types.get(name, pb.Value(name=name)) for name in between)
    _replace(graph, initializer=[tensor for tensor in graph.initializer if tensor.name not in direct])
    _keep(model, behind, graph.input, graph.output)
    return CutGraph(None if first is None else first.SerializeToString(), model, between, direct)


def with_outputs(model: bytes, names: Collection[str]) -> bytes:
    """Reduce a serialised graph to some of its outputs, and to what they follow from."""
    reduced = pb.Model.FromString(model)
    graph = reduced.graph
    nodes = _needed(list(graph.node), set(names))
    used = {name for node in nodes for name in node.input}
    inputs = [entry for entry in graph.input if entry.name in used]
    _keep(reduced, nodes, inputs, [entry for entry in graph.output if entry.name in names])
    return reduced.SerializeToString()


def _needed(nodes: list[pb.Node], names: set[str]) -> list[pb.Node]:
    """Return the nodes among some that tensors follow from, in order."""
    found = []
    for node in reversed(nodes):
        if names.intersection(node.output):
            names = names | set(node.input)
            found.append(node)
    return found[::-1]


def _keep(model: pb.Model, nodes: Iterable[pb.Node], inputs: Iterable[pb.Value], outputs: Iterable[pb.Value]) -> None:
    """Leave only these nodes, inputs and outputs in a model, and the initializers that they use."""
    graph = model.graph
    nodes, inputs, outputs = list(nodes), list(inputs), list(outputs)
    used = {name for node in nodes for name in node.input} | {value.name for value in (*inputs, *outputs)}
    held = [tensor for tensor in graph.initializer if tensor.name in used]
    _replace(graph, node=nodes, initializer=held, input=inputs, output=outputs, value_info=[])


def _replace(graph: pb.Graph, **parts: list[Any]) -> None:
    """Put other messages into repeated fields of a graph."""
    for field, messages in parts.items():
        graph.ClearField(field)
        getattr(graph, field).extend(messages)


class HeldTable:
    """Defaults of a table in memory, for graphs that are not in a bundle yet.

    Args:
        table: every tensor, by name.

    Attributes:
        table_inputs: type and shape of every tensor, by name.
    """

    def __init__(self, table: SamplingTable) -> None:
        self._table = {name: np.asarray(value) for name, value in table.items()}
        self.table_inputs = {name: Port(str(value.dtype), value.shape) for name, value in self._table.items()}

    def defaults(self, names: Collection[str]) -> dict[str, NDArray[np.generic]]:
        """Return some tensors of the table, by name."""
        return {name: self._table[name] for name in names}


def check_table(ports: Mapping[str, Port], table: SamplingTable) -> None:
    """Check tensors that are to stand in a table.

    Args:
        ports: type and shape of the table's tensors, by name.
        table: some of them.

    Raises:
        InvalidInputError: an unknown name, a wrong type or shape, or values that are not finite.
    """
    for name, value in table.items():
        port = ports.get(name)
        if port is None:
            raise InvalidInputError("table", repr(name), f"one of {sorted(ports)}")
        if not port.admits(str(value.dtype), value.shape):
            raise InvalidInputError(f"table {name}", f"{value.dtype} {value.shape}", f"{port.dtype} {port.shape}")
        if not np.isfinite(value).all():
            raise InvalidInputError(f"table {name}", "NaN or infinity", "finite numbers")


class TableGraph:
    """A graph and its table. It never changes; its methods may be called from many threads at once.

    Args:
        file: the graph as stored.
        subject: what it is, for errors.
        fed: names of table inputs that stay inputs, and are fed.
        threads: threads of one run; by default the cores that this process may use.
        table: values instead of the graph's defaults.
        like: the same graph with another table: what runs for every page is shared with it.
        profile: see `open_session`.
        provider: what pages are computed with; what is computed once is computed on the CPU.

    Attributes:
        steps, times: those of an estimator's graph: none, and no times.

    Raises:
        InvalidInputError: a table that does not fit.
        BundleError: the graph cannot be run.
        ProviderError: there is no such provider here.
    """

    def __init__(
        self,
        file: GraphFile,
        subject: str,
        fed: Collection[str],
        threads: int | None,
        table: SamplingTable | None = None,
        like: TableGraph | None = None,
        profile: Path | None = None,
        provider: Provider = ON_CPU,
    ) -> None:
        self._file, self._subject, self._fed_names, self._threads = file, subject, fed, threads
        self.provider = provider
        """What computes pages."""
        self.steps = 0
        self.times = StepTimes(0)
        self.ports = file.table_inputs
        """Type and shape of every tensor of the table, by name."""
        self.table: SamplingTable = table or {}
        self.check(self.table)
        parts = file.cut(self.table, fed)
        between: dict[str, NDArray[Any]] = {}
        if parts.before is not None:  # else nothing follows from the table alone
            before = open_session(parts.before, subject, threads, once=True)
            with running(subject):
                between = dict(zip(parts.between, before.run(parts.between, {}), strict=True))
        between |= {name: self.value(name) for name in parts.direct}
        fed_values = {name: self.value(name) for name in self.ports.keys() & set(fed)}
        if like is not None and between:
            self.session: Session = like.session
        else:
            model = parts.behind_with(between)
            self.session = open_session(model, subject, threads, profile=profile, provider=provider)
        held = fed_values | between
        self._held = frozenset(held)
        self._bound = BoundSession(self.session, provider, held, subject)

    def with_table(self, table: SamplingTable) -> TableGraph:
        """The graph with other tensors in its table, by name; those left out stay. It raises as the constructor does.

        On a GPU the new table's tensors lie beside those of this one, as long as both are held.
        """
        merged = {**self.table, **table}
        names, threads = self._fed_names, self._threads
        return TableGraph(self._file, self._subject, names, threads, merged, like=self, provider=self.provider)

    @property
    def inputs(self) -> dict[str, Port]:
        """Type and shape of what must be fed with each page, by name."""
        nodes = self.session.get_inputs()
        return {node.name: Port.of(node) for node in nodes if node.name not in self._held}

    @property
    def outputs(self) -> dict[str, Port]:
        """Type and shape of what can be asked for, by name."""
        return {node.name: Port.of(node) for node in self.session.get_outputs()}

    def value(self, name: str) -> NDArray[Any]:
        """A tensor of the table, as the graph is run with it.

        Raises:
            InvalidInputError: no such tensor.
        """
        if name not in self.ports:
            raise InvalidInputError("table", repr(name), f"one of {sorted(self.ports)}")
        return self.table[name] if name in self.table else self._file.default(name)

    def check(self, table: SamplingTable) -> None:
        """Check tensors that are to stand in the table instead of the graph's defaults.

        Raises:
            InvalidInputError: an unknown name, a wrong type or shape, or values that are not finite.
        """
        check_table(self.ports, table)

    def run(self, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """Run the graph; `feeds` holds the frames, and table tensors for this run alone."""
        return self._bound.run(outputs, feeds)

    run_whole = run
