"""What eight-bit integers in the network's convolutions save, and what they cost.

    python -m benchmarks.int8 --bundle runtime/bundles/bench.zip --recording bench.h5

The same decoder twice in the same ONNX Runtime, taking turns: as exported, and with every 3x3 convolution of its
networks quantised, weights by channel, inputs by the range that some pages of the recording give.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime.quantization import (  # type: ignore[import-untyped]
    CalibrationDataReader,
    QuantFormat,
    QuantType,
    quantize_static,
)

from export.graph import FRAME_INPUTS, HALVED
from optics.measures import measure
from optics.recording import Recording
from runtime.bundle import Bundle
from runtime.ort import open_session

Feeds = dict[str, NDArray[np.generic]]


class Ranges(CalibrationDataReader):  # type: ignore[misc]
    """Frames of some pages, by which the ranges are set."""

    def __init__(self, feeds: Iterator[Feeds]) -> None:
        self._feeds = feeds

    def get_next(self) -> Feeds | None:
        return next(self._feeds, None)


def feeds_of(recording: Recording, page: int) -> Feeds:
    pair = recording.frames(page)
    return dict(zip(FRAME_INPUTS, (pair.in_phase, pair.quadrature), strict=True))


def single_precision(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with its weights as they are computed with, and no casts in their way."""
    held = {tensor.name: tensor for tensor in model.graph.initializer}
    casts = [node for node in model.graph.node if node.op_type == "Cast" and node.input[0] in held]
    for cast in casts:
        weights = numpy_helper.to_array(held[cast.input[0]]).astype(np.float32)
        model.graph.initializer.append(numpy_helper.from_array(weights, cast.output[0]))
        model.graph.node.remove(cast)
    return model


def convolutions(model: onnx.ModelProto) -> list[str]:
    """Names of the networks' 3x3 convolutions."""
    sizes = {tensor.name: tuple(tensor.dims[2:]) for tensor in model.graph.initializer}
    return [
        node.name
        for node in model.graph.node
        if node.op_type == "Conv" and sizes.get(node.input[1]) == (3, 3) and node.input[1].split(".")[1] in HALVED
    ]


def air(p: NDArray[np.float32], symbols: NDArray[np.uint8], levels: int) -> float:
    """Bits a symbol that are right, with the page's piston taken from its symbols."""
    belief = p[0] + 1j * p[1]
    piston = np.angle(np.sum(belief * np.exp(-2j * np.pi * symbols / levels)))
    return measure(np.angle(belief) - piston, np.abs(belief), symbols, levels).air_bits_per_symbol


@click.command()
@click.option("--bundle", "path", type=click.Path(exists=True, path_type=Path), required=True)
@click.option("--recording", "recorded", type=click.Path(exists=True, path_type=Path), required=True)
@click.option("--pages", default=8, show_default=True, help="Of the recording, from the first: before its image walks.")
@click.option("--threads", type=click.IntRange(1))
def main(path: Path, recorded: Path, pages: int, threads: int | None) -> None:
    """Print time and AIR of both, and their ratio and difference."""
    exported = Bundle.open(path).files["decoder.onnx"]
    model = single_precision(onnx.load_from_string(exported))
    with Recording.open(recorded) as recording, tempfile.TemporaryDirectory() as folder:
        names = convolutions(model)
        inner, outer = Path(folder) / "in.onnx", Path(folder) / "out.onnx"
        onnx.save(model, inner)
        quantize_static(
            inner,
            outer,
            Ranges(feeds_of(recording, page) for page in range(pages, pages + 4)),
            quant_format=QuantFormat.QDQ,
            nodes_to_quantize=names,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        sessions = [open_session(file, "int8", threads) for file in (exported, outer.read_bytes())]
        seconds: list[list[float]] = []
        rates: list[list[float]] = []
        for page in range(pages):
            symbols = recording.symbols(page)
            assert symbols is not None
            feeds = feeds_of(recording, page)
            taken = []
            beliefs = []
            for session in sessions:
                time.sleep(0.2)
                start = time.perf_counter()
                beliefs.append(session.run(["p"], feeds)[0])
                taken.append(time.perf_counter() - start)
            seconds.append(taken)
            rates.append([air(p, symbols, recording.levels) for p in beliefs])
    plain, quantised = np.median(np.array(seconds[1:]), axis=0)
    click.echo(f"{len(names)} convolutions; {1e3 * plain:.0f} ms as exported, {1e3 * quantised:.0f} with them in int8")
    click.echo(f"time over that as exported: {quantised / plain:.2f}")
    click.echo("AIR {:.3f} and {:.3f} bits/symbol".format(*np.mean(rates, axis=0)))


if __name__ == "__main__":
    main()
