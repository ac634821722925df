"""Torch modules to ONNX files: inputs with defaults, names that the runtime knows."""

from __future__ import annotations

import ast
import hashlib
import logging
import math
import re
import warnings
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxscript import optimizer
from torch import nn

from lightpage.calibration.parameters import nominal
from lightpage.export.graph import FRAME_INPUTS, HALVED, FieldGraph, Graph
from lightpage.train.models.twin import RayTwin

OPSET = 20
FOLDED = 20_000
"""Largest constant, elements, that folding may leave in a file: a runtime folds the rest when it loads the graph."""
_SHARED = 1_000
"""Smallest constant, elements, that is kept once where several are alike."""
_SCOPES = "pkg.torch.onnx.name_scopes"
"""The exporter's note of a node's modules, the outermost first, and last the node itself."""
TWIN_INPUTS = ("parameters", "points", "anchors", "camera_places")
TWIN_OUTPUTS = ("places", "phases", "positions", "pixels")


def decoder_onnx(
    graph: Graph, frame_dtype: str, frame_shape: tuple[int, int], defaults: dict[str, NDArray[np.generic]]
) -> bytes:
    """The decoder as ONNX, the calibrated table as the default of its inputs.

    Args:
        graph: the decoder, in evaluation mode.
        frame_dtype: "uint8" or "uint16".
        frame_shape: (rows, columns).
        defaults: tensor of every input behind the frames, in order.
    """
    frame = torch.from_numpy(np.zeros(frame_shape, dtype=frame_dtype))
    # torch.export takes one tensor given twice for one input, hence the clone below
    tensors = [torch.from_numpy(np.ascontiguousarray(value)) for value in defaults.values()]
    model = exported(graph, (frame, frame.clone(), *tensors), (*FRAME_INPUTS, *defaults), graph.outputs, None)
    halved(model, re.compile(rf"^decoder\.({'|'.join(HALVED)})\."))
    for name, value in defaults.items():
        model.graph.initializer.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def field_onnx(graph: FieldGraph, frame_dtype: str, tensors: dict[str, NDArray[np.generic]]) -> bytes:
    """The field recovery as ONNX; `tensors` are examples of its `table_inputs`."""
    frame = torch.from_numpy(np.zeros(tensors["reference_in_phase"].shape, dtype=frame_dtype))
    names = graph.table_inputs
    chosen = [torch.from_numpy(np.ascontiguousarray(tensors[name])) for name in names]
    model = exported(graph, (frame, frame.clone(), *chosen), (*FRAME_INPUTS, *names), graph.outputs, None)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def twin_onnx(twin: RayTwin) -> bytes:
    """The ray twin as ONNX, any number of points."""
    example = torch.zeros(3, 2, dtype=torch.float64)
    points, places = torch.export.Dim("points", min=1), torch.export.Dim("camera_points", min=1)
    shapes: tuple[dict[int, Any], ...] = ({}, {0: points}, {0: points}, {0: places})
    inputs = (torch.from_numpy(nominal()), example, example.clone(), torch.zeros(5, 2, dtype=torch.float64))
    model = exported(twin, inputs, TWIN_INPUTS, TWIN_OUTPUTS, shapes)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def exported(
    module: nn.Module,
    inputs: tuple[torch.Tensor, ...],
    names: tuple[str, ...],
    outputs: tuple[str, ...],
    shapes: tuple[Any, ...] | None,
) -> onnx.ModelProto:
    """A module as an ONNX model.

    Args:
        module, inputs: it, and tensors to trace it with.
        names, outputs: names of inputs and outputs.
        shapes: free dimensions of every input; None where there are none.
    """
    # it tells of every optional package that the graphs have no use for
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module.eval(),
            inputs,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(names),
            output_names=list(outputs),
            dynamic_shapes=shapes,
            external_data=False,
            verbose=False,
            optimize=False,
        )
        assert program is not None
        # all that pays of the exporter's optimiser, whose rewriter takes minutes over a pipe's unrolled steps
        optimizer.fold_constants(program.model, output_size_limit=FOLDED)
        optimizer.remove_unused_nodes(program.model)
    return anonymous(sharing(program.model_proto))


def sharing(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with each large constant once: both ways of a wave model have many that are alike."""
    graph, instead = model.graph, dict[str, str]()
    first: dict[tuple[int, tuple[int, ...], bytes], str] = {}
    for held in graph.initializer:
        if math.prod(held.dims) >= _SHARED:
            content = held.data_type, tuple(held.dims), hashlib.sha256(numpy_helper.to_array(held).tobytes()).digest()
            if (name := first.setdefault(content, held.name)) != held.name:
                instead[held.name] = name
    kept = [held for held in graph.initializer if held.name not in instead]
    del graph.initializer[:]
    graph.initializer.extend(kept)
    for node in graph.node:
        node.input[:] = [instead.get(name, name) for name in node.input]
    return model


def halved(model: onnx.ModelProto, named: re.Pattern[str]) -> None:
    """Keep the initializers with such names as float16: a runtime folds the casts back when it loads the graph."""
    casts = []
    for held in model.graph.initializer:
        if named.search(held.name) and held.data_type == onnx.TensorProto.FLOAT:
            name = held.name
            held.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(held).astype(np.float16), f"{name}.half"))
            casts.append(onnx.helper.make_node("Cast", [held.name], [name], to=onnx.TensorProto.FLOAT))
    for cast in reversed(casts):
        model.graph.node.insert(0, cast)


def _module_of(node: onnx.NodeProto) -> list[str]:
    """Path of the module that a node comes from, e.g. decoder, network, stem."""
    notes = {note.key: note.value for note in node.metadata_props}
    scopes = ast.literal_eval(notes.get(_SCOPES, "['']"))
    return scopes[-2].split(".") if len(scopes) > 1 and scopes[-2] else []


def anonymous(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model without the exporter's notes, which name the files of the machine that exported it.

    Nodes are named after the module that they come from.
    """
    for node in model.graph.node:
        node.name = "/".join([*_module_of(node), node.name])
    graphs: list[Any] = [model.graph, *model.functions]
    parts = [part for graph in graphs for part in (*graph.node, *graph.value_info)]
    noted = [model, *graphs, *parts, *model.graph.input, *model.graph.output, *model.graph.initializer]
    for owner in noted:
        owner.doc_string = ""
        del owner.metadata_props[:]
    return model
