"""Nodes of page graphs that depend on a device alone, moved to the graph of its operators.

A runtime then computes them once for each device, and not for each page. Nodes that several page graphs have in common
are computed once for all of them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import onnx

_Key = tuple[str, str, tuple[str, ...], tuple[bytes, ...]]


def move_device_constants(
    device: onnx.ModelProto, pages: Mapping[str, onnx.ModelProto], fixed: Collection[str]
) -> None:
    """Move nodes from page graphs to the graph of a device, in place.

    Args:
        device: graph of the device's operators. Its outputs become those that page graphs take.
        pages: graphs of first estimate and steps, by a name that is part of their tensors' new names.
        fixed: inputs of page graphs that depend on the device alone.
    """
    moved = _DeviceNodes(device.graph)
    outputs = {entry.name: entry for entry in device.graph.output}
    for title, page in pages.items():
        inferred = onnx.shape_inference.infer_shapes(page)
        outputs |= _moved_from(inferred, page.graph, f"device.{title}", {*fixed}, moved)
    used = {entry.name for page in pages.values() for entry in page.graph.input}
    device.graph.ClearField("output")
    device.graph.output.extend(entry for name, entry in outputs.items() if name in used)
    onnx.checker.check_model(device)


class _DeviceNodes:
    """Nodes of the device graph, which grows.

    Args:
        graph: the device graph.
    """

    def __init__(self, graph: onnx.GraphProto) -> None:
        self._graph = graph
        self._known: dict[_Key, tuple[str, ...]] = {}
        self._initializers = {_content(tensor): tensor.name for tensor in graph.initializer}
        self._inputs = {entry.name for entry in (*graph.input, *graph.output)}

    def add_input(self, entry: onnx.ValueInfoProto) -> None:
        """Add an input, unless the graph has or computes it."""
        if entry.name not in self._inputs:
            self._inputs.add(entry.name)
            self._graph.input.add().CopyFrom(entry)

    def add_initializer(self, tensor: onnx.TensorProto, name: str) -> str:
        """Add a constant unless the graph has it already, and return its name."""
        known_name = self._initializers.get(_content(tensor))
        if known_name is None:
            known_name = self._initializers[_content(tensor)] = name
            copied = self._graph.initializer.add()
            copied.CopyFrom(tensor)
            copied.name = name
        return known_name

    def add_node(self, node: onnx.NodeProto, names: dict[str, str], title: str) -> None:
        """Add a node unless the graph has the same one already.

        Args:
            node: node of a page graph.
            names: new names of the page graph's tensors, which get those of the node's outputs.
            title: first part of the new names.
        """
        inputs = tuple(names.get(name, name) for name in node.input)
        attributes = tuple(sorted(attribute.SerializeToString() for attribute in node.attribute))
        key = node.op_type, node.domain, inputs, attributes
        outputs = self._known.get(key)
        if outputs is None:
            outputs = self._known[key] = tuple(name and f"{title}.{name}" for name in node.output)
            copied = self._graph.node.add()
            copied.CopyFrom(node)
            copied.name = f"{title}.{node.name}"
            copied.input[:] = inputs
            copied.output[:] = outputs
        names.update(zip(node.output, outputs, strict=True))


def _moved_from(
    inferred: onnx.ModelProto, graph: onnx.GraphProto, title: str, fixed: set[str], moved: _DeviceNodes
) -> dict[str, onnx.ValueInfoProto]:
    """Move the nodes of one page graph; return the outputs that the device graph gets for it, by name."""
    varying = {entry.name for entry in graph.input} - fixed
    derived = set(fixed)
    device_nodes: list[onnx.NodeProto] = []
    remaining: list[onnx.NodeProto] = []
    for node in graph.node:
        if varying.intersection(node.input):
            varying.update(node.output)
            remaining.append(node)
        elif derived.intersection(node.input):
            derived.update(node.output)
            device_nodes.append(node)
        else:  # constants, which the runtime folds
            remaining.append(node)
    computed = {name for node in device_nodes for name in node.output}
    wanted = {name for node in remaining for name in node.input} | {entry.name for entry in graph.output}
    constants = _producers(remaining, {name for node in device_nodes for name in node.input} - computed)
    inputs = {entry.name: entry for entry in graph.input}
    names: dict[str, str] = {}
    used = {name for node in (*constants, *device_nodes) for name in node.input}
    for name in used.intersection(inputs):
        moved.add_input(inputs[name])
    for tensor in graph.initializer:
        if tensor.name in used:
            names[tensor.name] = moved.add_initializer(tensor, f"{title}.{tensor.name}")
    for node in (*constants, *device_nodes):
        moved.add_node(node, names, title)
    types = {entry.name: entry for entry in (*inferred.graph.value_info, *graph.output)}
    outputs: dict[str, onnx.ValueInfoProto] = {}
    renamed: dict[str, str] = {}
    for name in sorted(computed & wanted):
        entry = onnx.ValueInfoProto()
        entry.CopyFrom(types[name])
        entry.name = renamed[name] = names[name]
        outputs[entry.name] = entry
    _keep(graph, remaining, renamed, outputs.values())
    return outputs


def _keep(
    graph: onnx.GraphProto,
    nodes: list[onnx.NodeProto],
    renamed: Mapping[str, str],
    inputs: Iterable[onnx.ValueInfoProto],
) -> None:
    """Leave only some nodes in a graph, and the inputs and initializers that they use."""
    kept = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
    for node in kept:
        node.input[:] = [renamed.get(name, name) for name in node.input]
    used = {name for node in kept for name in node.input} | {entry.name for entry in graph.output}
    entries = [entry for entry in (*graph.input, *inputs) if entry.name in used]
    initializers = [tensor for tensor in graph.initializer if tensor.name in used]
    for field, messages in (("node", kept), ("input", entries), ("initializer", initializers), ("value_info", [])):
        graph.ClearField(field)
        getattr(graph, field).extend(messages)


def _producers(nodes: Iterable[onnx.NodeProto], names: set[str]) -> list[onnx.NodeProto]:
    """Return the nodes that some tensors follow from, in order."""
    producers: list[onnx.NodeProto] = []
    for node in reversed([*nodes]):
        if names.intersection(node.output):
            names = names | {*node.input}
            producers.append(node)
    return producers[::-1]


def _content(tensor: onnx.TensorProto) -> bytes:
    """Contents of a tensor without its name."""
    copied = onnx.TensorProto()
    copied.CopyFrom(tensor)
    copied.name = ""
    return bytes(copied.SerializeToString(deterministic=True))
