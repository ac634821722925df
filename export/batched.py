"""A decoder for many pages as two graphs: the constants of a device's table, and frames with these to p.

The first is evaluated once for each table, the second for each batch. So a re-fit feeds the same numbers to this form
as to that for one page, and no start computes more than the constants.
"""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnxscript import ir, optimizer
from torch import Tensor, nn

from lightpage.export.graph import ANSWERS, FRAME_INPUTS, DecoderGraph, answers
from lightpage.export.onnx_files import FOLDED, OPSET, anonymous, halved, sharing
from lightpage.progress import warn
from lightpage.runtime.model.bundle.manifest import BATCH, CONSTANTS
from lightpage.runtime.model.decoding.batch_graph import SHIFT
from lightpage.train.models.batched.decoder import BatchedDecoder

PAGES = "pages"
"""Name of the axis of pages, which a session may be opened with a number for."""
OUTPUTS = (*ANSWERS, "residual")
_MATRICES = re.compile(r"\.(up_.|down|across|network\.\S*weight|unet\.\S*weight)$")
"""Names of buffers that are factors of products in float16 anyway. The pipe's bases stay exact: their products must be
unitary."""
_EXAMPLE = 1
"""Pages that the exporter is shown."""


class ConstantsGraph(nn.Module):
    """A device's table to the constants of `BatchGraph`, in the order of their `names`.

    Args:
        decoder: the batched decoder.
        inputs: names of the table's tensors, in order.
    """

    def __init__(self, decoder: BatchedDecoder, inputs: tuple[str, ...]) -> None:
        super().__init__()
        self.decoder, self.inputs = decoder, inputs
        self.names: tuple[str, ...] = ()
        """Of those that are asked for; at first, of all."""

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """The table's tensors to the constants."""
        made = self.decoder.tables(dict(zip(self.inputs, tensors, strict=True)))
        self.names = self.names or tuple(made)
        return tuple(made[name] for name in self.names)


class BatchGraph(nn.Module):
    """Frames of B pages and constants to `OUTPUTS`.

    Args:
        decoder: the batched decoder.
        names: names of the constants, in order.
        kappa_scale: factor on p that makes its length a calibrated concentration.
    """

    def __init__(self, decoder: BatchedDecoder, names: tuple[str, ...], kappa_scale: float) -> None:
        super().__init__()
        self.decoder, self.names, self.kappa_scale = decoder, names, kappa_scale

    def forward(self, in_phase: Tensor, quadrature: Tensor, shift: Tensor, *constants: Tensor) -> tuple[Tensor, ...]:
        """Frames [B, H, W], shifts [B, 2, 2] and constants to p [B, 2, ny, nx] and the other `OUTPUTS`.

        Phase and concentration are [B, ny, nx], the residual is [B]; see `BatchedDecoder.forward`.
        """
        p, residual = self.decoder(in_phase, quadrature, shift, dict(zip(self.names, constants, strict=True)))
        return *answers(p * self.kappa_scale, 1), residual


def batched_onnx(
    graph: DecoderGraph, frame_dtype: str, defaults: dict[str, NDArray[np.generic]], dtype: torch.dtype
) -> tuple[bytes, bytes] | None:
    """Both graphs as ONNX; None for a device whose cameras stand apart, which no batched form decodes.

    Args:
        graph: the decoder for one page, in evaluation mode.
        frame_dtype: "uint8" or "uint16".
        defaults: the calibrated table, by name.
        dtype: type in which pages are computed, float16 or float32.
    """
    if graph.apart:
        return None
    decoder = BatchedDecoder(graph.recovery, graph.decoder, 8 * np.dtype(frame_dtype).itemsize, dtype).eval()
    constants = ConstantsGraph(decoder, tuple(defaults)).eval()
    tensors = [torch.from_numpy(np.ascontiguousarray(value)) for value in defaults.values()]
    with torch.no_grad():
        made = constants(*tensors)
    rows, columns = graph.recovery.rows_px, graph.recovery.columns_px
    frames = torch.zeros((_EXAMPLE, rows, columns), dtype=getattr(torch, frame_dtype))
    batch = BatchGraph(decoder, constants.names, graph.kappa_scale).eval()
    inputs = frames, frames.clone(), torch.zeros((_EXAMPLE, 2, 2)), *made
    of_pages = *FRAME_INPUTS, SHIFT
    second = traced(batch, inputs, (*of_pages, *constants.names), OUTPUTS, (*of_pages, *OUTPUTS))
    taken = {entry.name for entry in second.graph.input}
    constants.names = tuple(name for name in constants.names if name in taken)
    first = traced(constants, tuple(tensors), constants.inputs, constants.names)
    return bytes(first.SerializeToString()), bytes(second.SerializeToString())


def files_for_batches(
    graph: DecoderGraph, frame_dtype: str, defaults: dict[str, NDArray[np.generic]]
) -> dict[str, bytes]:
    """Both graphs in float16 as files of a bundle; none, with a warning, for a device that they do not decode."""
    made = batched_onnx(graph, frame_dtype, defaults, torch.float16)
    if made is None:
        warn("no decoder for many pages: the cameras of this device stand apart, or are tilted against each other")
        return {}
    return dict(zip((CONSTANTS, BATCH), made, strict=True))


def traced(
    module: nn.Module,
    inputs: tuple[Tensor, ...],
    names: tuple[str, ...],
    outputs: tuple[str, ...],
    of_pages: tuple[str, ...] = (),
) -> onnx.ModelProto:
    """A module as ONNX by what it does to these inputs; a tenth of the time that an export by symbols takes.

    Args:
        module, inputs: it, and tensors to trace it with.
        names, outputs: names of inputs and outputs.
        of_pages: which of them have the axis of pages first.
    """
    with _named(module), warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "traced.onnx"
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            inputs,
            file,
            dynamo=False,
            do_constant_folding=False,
            opset_version=OPSET,
            input_names=list(names),
            output_names=list(outputs),
            dynamic_axes={name: {0: PAGES} for name in of_pages},
        )
        traced_model = ir.from_proto(onnx.load(file))
    optimizer.fold_constants(traced_model, output_size_limit=FOLDED)
    optimizer.remove_unused_nodes(traced_model)
    model = anonymous(sharing(ir.to_proto(traced_model)))
    halved(model, _MATRICES)
    onnx.checker.check_model(model)
    return model


@contextmanager
def _named(module: nn.Module) -> Iterator[None]:
    """While it is exported, a module's buffers stay tensors of the file by their names, and are not computed with."""
    kept = {part: set(part._non_persistent_buffers_set) for part in module.modules()}
    for part in kept:
        part._non_persistent_buffers_set.clear()
    try:
        yield
    finally:
        for part, names in kept.items():
            part._non_persistent_buffers_set.update(names)
