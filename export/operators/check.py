"""Finds nodes of a graph that an execution provider has no kernel for, by its operator list, without its hardware."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import zip_longest

import onnx
from onnx import shape_inference
from onnx.defs import OpSchema

from lightpage.errors import InvalidInputError
from lightpage.export.operators.operator_list import FLOATING, Kernel, Operator, OperatorList, dtype_name
from lightpage.runtime.model.execution.page_graph import PAGE_INPUTS
from lightpage.runtime.model.execution.table_graph import GraphFile

_SHAPES = frozenset(["Shape", "Size"])
_RANDOM = frozenset(["Bernoulli", "Multinomial", "RandomNormalLike", "RandomUniformLike"])
"""Operators whose outputs differ from run to run though their inputs are constants."""
_UNKNOWN = "unknown"


@dataclass(frozen=True)
class Fallback:
    """A node that runs elsewhere than on the provider.

    Attributes:
        node: its name, or that of its first output where it has none.
        operator: name, behind its domain where that is not ONNX's own.
        version: version of the operator, not of the whole set; 0 where it is unknown.
        got: what is in the graph.
        expected: what the provider has.
    """

    node: str
    operator: str
    version: int
    got: str
    expected: str


@dataclass(frozen=True)
class _Tensor:
    """Element type and number of axes, None where they cannot be inferred."""

    dtype: str | None
    rank: int | None


def fallbacks(model: bytes, provider: str | OperatorList) -> list[Fallback]:
    """The nodes that a provider has no kernel for, in order.

    Left out are nodes that depend on constants alone, which onnxruntime computes when it loads the graph, and those of
    `shape_computations`. The list knows types and versions; it does not know what a kernel refuses for its attributes.

    Args:
        model: serialised; a part of a decoder as `page_part` gives it, or any graph.
        provider: one of `operator_list.PROVIDERS`, or a list.

    Raises:
        InvalidInputError: no such provider, or a graph that holds graphs within nodes, which are not looked into.
    """
    listed = OperatorList.load(provider) if isinstance(provider, str) else provider
    graph = _Graph(onnx.load_from_string(model))
    shapes = set(shape_computations(model))
    judged = (_fallback(node, graph, listed) for node in graph.running() if _name(node) not in shapes)
    return [fallback for fallback in judged if fallback is not None]


def shape_computations(model: bytes) -> list[str]:
    """Nodes that compute integers from the shapes of tensors alone, by name.

    onnxruntime places them on the CPU on purpose, where the sizes that other nodes ask for are needed. Source:
    `GetCpuPreferredNodes` in onnxruntime/core/framework/fallback_cpu_capability.cc.

    Raises:
        InvalidInputError: as for `fallbacks`.
    """
    graph = _Graph(onnx.load_from_string(model))
    sizes: set[str] = set()
    found = []
    for node in graph.running():
        inputs = {name for name in node.input if name} - graph.constants
        if node.op_type in _SHAPES and _domain(node) == "":
            sizes.update(node.output)
        elif inputs and inputs <= sizes and all(graph.tensor(name).dtype == "int64" for name in node.output):
            sizes.update(node.output)
            found.append(_name(node))
    return found


def repeated_products(model: bytes) -> list[str]:
    """Products that repeat both of their factors, each along another axis, by name.

    Onnxruntime's CUDA provider computes them wrongly where the factors hold equally many matrices: of a product of
    [2, 1, I, J] and [1, 2, J, K] half is left zero. Seen on an H200 with onnxruntime-gpu 1.31.1; the CPU is right.

    Raises:
        InvalidInputError: a product of tensors whose shapes cannot be inferred.
    """
    graph = shape_inference.infer_shapes(onnx.load_from_string(model), data_prop=True).graph
    shapes = {tensor.name: list(tensor.dims) for tensor in graph.initializer}
    for value in (*graph.value_info, *graph.input, *graph.output):
        axes = value.type.tensor_type.shape.dim
        shapes[value.name] = [axis.dim_value if axis.HasField("dim_value") else -1 for axis in axes]
    found = []
    for node in graph.node:
        if node.op_type != "MatMul":
            continue
        if unknown := [name for name in node.input if -1 in shapes.get(name, [-1])]:
            raise InvalidInputError(
                f"node {_name(node)}", f"no shape of {', '.join(unknown)}", "shapes of both factors"
            )
        pairs = list(zip_longest(*(shapes[name][-3::-1] for name in node.input), fillvalue=1))
        if any(left < right for left, right in pairs) and any(left > right for left, right in pairs):
            found.append(_name(node))
    return found


def page_part(decoder: bytes, fed: Collection[str] = PAGE_INPUTS) -> bytes:
    """The part of a decoder that runs for every page, as onnxruntime is given it, with the types of its inputs.

    Args:
        decoder: decoder.onnx of a bundle, with the types of its tensors.
        fed: names of table inputs that stay inputs.

    Raises:
        BundleError: the bytes are no ONNX model.
        InvalidInputError: the model does not say the type of a tensor that it is cut at.
    """
    cut = GraphFile(decoder, "decoder.onnx").cut({}, fed)
    whole = shape_inference.infer_shapes(onnx.load_from_string(decoder)).graph
    known = {value.name: value for value in (*whole.value_info, *whole.output, *whole.input)}
    part = onnx.load_from_string(cut.behind.SerializeToString())
    for name in (*cut.between, *cut.direct):
        if name not in known:
            raise InvalidInputError(f"decoder.onnx: tensor {name}", "no type", "the type of every tensor")
        part.graph.input.append(known[name])
    return bytes(part.SerializeToString())


class _Graph:
    """A model's nodes, which of its tensors are constants, and the types of all of them."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self.nodes = list(model.graph.node)
        for node in self.nodes:
            if any(attribute.HasField("g") or attribute.graphs for attribute in node.attribute):
                raise InvalidInputError(f"node {_name(node)}", "a graph within it", "a node without inner graphs")
        self.opsets = {"" if entry.domain == "ai.onnx" else entry.domain: entry.version for entry in model.opset_import}
        fed = {value.name for value in model.graph.input}
        self.constants = {tensor.name for tensor in model.graph.initializer} - fed
        for node in self.nodes:
            if node.op_type == "Constant" or (node.op_type not in _RANDOM and self._constant_inputs(node)):
                self.constants.update(node.output)
        self._tensors = _tensors(model, {name for node in self.nodes if not self.schema(node) for name in node.output})

    def _constant_inputs(self, node: onnx.NodeProto) -> bool:
        inputs = {name for name in node.input if name}
        return bool(inputs) and inputs <= self.constants

    def running(self) -> Iterator[onnx.NodeProto]:
        """Nodes that are not computed before the first run."""
        return (node for node in self.nodes if not self.constants.issuperset(node.output))

    def tensor(self, name: str) -> _Tensor:
        """Return what is known of a tensor."""
        return self._tensors.get(name, _Tensor(None, None))

    def schema(self, node: onnx.NodeProto) -> OpSchema | None:
        """ONNX's description of a node's operator, in the version that the model asks for."""
        domain = _domain(node)
        try:
            return onnx.defs.get_schema(node.op_type, self.opsets.get(domain, 1), domain)
        except onnx.defs.SchemaError:
            return None


def _tensors(model: onnx.ModelProto, foreign: Collection[str]) -> dict[str, _Tensor]:
    """Return the known types of every tensor: inferred from the inputs on, and by the model itself where that ends.

    Args:
        foreign: tensors whose types ONNX cannot infer and the model's word is taken for.
    """
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.graph.value_info[:]
    bare.graph.value_info.extend(value for value in model.graph.value_info if value.name in foreign)
    graph = shape_inference.infer_shapes(bare, data_prop=True).graph
    said = (*model.graph.value_info, *graph.output, *graph.value_info, *graph.input)
    held = {tensor.name: _Tensor(_element(tensor.data_type), len(tensor.dims)) for tensor in model.graph.initializer}
    return {value.name: _described(value) for value in said} | held


def _described(value: onnx.ValueInfoProto) -> _Tensor:
    tensor = value.type.tensor_type
    rank = len(tensor.shape.dim) if tensor.HasField("shape") else None
    return _Tensor(_element(tensor.elem_type) if tensor.elem_type else None, rank)


def _element(number: int) -> str:
    return dtype_name(onnx.TensorProto.DataType.Name(number).lower())


def _fallback(node: onnx.NodeProto, graph: _Graph, listed: OperatorList) -> Fallback | None:
    """Why a provider does not run a node; None where it does."""
    domain, schema = _domain(node), graph.schema(node)
    operator = listed.operators.get((domain, node.op_type))
    version = schema.since_version if schema is not None else graph.opsets.get(domain, 0)
    title = f"{domain}:{node.op_type}" if domain else node.op_type

    def because(got: str, expected: str) -> Fallback:
        return Fallback(_name(node), title, version, got, expected)

    if operator is None:
        return because(f"operator {title}", f"an operator of {listed.provider}")
    opset = graph.opsets.get("", 0)
    if listed.opsets is not None and not listed.opsets[0] <= opset <= listed.opsets[1]:
        return because(f"opset {opset}", "opset {} to {}".format(*listed.opsets))
    kernels = [kernel for kernel in operator.kernels if kernel.implements(version)]
    if not kernels:
        return because(f"version {version}", " or ".join(_range(kernel) for kernel in operator.kernels))
    variables = _variables(node, operator, schema)
    wrong = min((_wrong_types(kernel, variables, graph) for kernel in kernels), key=len)
    wrong += [] if schema is None else _wrong_inputs(node, operator, schema, graph)
    if wrong:
        return because(*(", ".join(part) for part in zip(*wrong, strict=True)))
    return None


def _range(kernel: Kernel) -> str:
    last = "" if kernel.until in (None, kernel.since) else f" to {kernel.until}"
    return f"version {kernel.since}{last}"


def _wrong_types(kernel: Kernel, variables: Mapping[str, str], graph: _Graph) -> list[tuple[str, str]]:
    """Return what is there and what a kernel takes, of tensors whose type it does not take.

    Args:
        variables: type variable of every tensor, by its name.
    """
    wrong = []
    for name, variable in variables.items():
        types, dtype = kernel.types.get(variable), graph.tensor(name).dtype
        if types is not None and dtype not in types:
            wrong.append((f"{name} of {dtype or _UNKNOWN}", f"one of {' '.join(sorted(types))}"))
    return wrong


def _wrong_inputs(node: onnx.NodeProto, operator: Operator, schema: OpSchema, graph: _Graph) -> list[tuple[str, str]]:
    """Return the mistakes of inputs that are computed but must be constants, and of a first input's axes."""
    wrong = []
    for name, formal in zip(node.input, schema.inputs, strict=False):
        if formal.name in operator.constant and name and name not in graph.constants:
            wrong.append((f"{formal.name} that is computed", f"constant {formal.name}"))
    if operator.rank is not None and (rank := graph.tensor(node.input[0]).rank) != operator.rank:
        wrong.append((f"{node.input[0]} of {_UNKNOWN if rank is None else rank} axes", f"{operator.rank} axes"))
    return wrong


def _variables(node: onnx.NodeProto, operator: Operator, schema: OpSchema | None) -> dict[str, str]:
    """Type variable of every tensor of a node, by its name."""
    inputs, outputs = operator.inputs, operator.outputs
    if schema is not None:
        names = {}
        if any(FLOATING in kernel.types for kernel in operator.kernels):
            constraints = ((one.type_param_str, one.allowed_type_strs) for one in schema.type_constraints)
            names = {variable: FLOATING for variable, allowed in constraints if "tensor(float)" in allowed}
        inputs = tuple(names.get(one.type_str, one.type_str) for one in schema.inputs)
        outputs = tuple(names.get(one.type_str, one.type_str) for one in schema.outputs)
    found = {}
    for tensors, variables in ((node.input, inputs), (node.output, outputs)):
        for number, name in enumerate(tensors):
            if name and variables:  # the last of a variadic operator stands for all further ones
                found[name] = variables[min(number, len(variables) - 1)]
    return found


def _domain(node: onnx.NodeProto) -> str:
    return "" if node.domain == "ai.onnx" else str(node.domain)


def _name(node: onnx.NodeProto) -> str:
    return str(node.name or node.output[0])
