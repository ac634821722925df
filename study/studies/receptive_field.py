"""Study of receptive fields: the reach of each layer of the published U-Net, measured by gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from lightpage.progress import Progress
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.train.published.unet import HEAD_STRIDES, PublishedUNet

EXPECTED = (5, 9, 13, 17, 25, 33, 33)
"""Samples, for strides of 2 where the published table prints 3."""
_SIDE = 96
_WHOLE_SIDE = 320
_CHANNELS = (4, 8)


def field_of_layers() -> list[int]:
    """Samples along an axis that each layer at sample pitch sees, the U left out: what its table lists."""
    network = _network(4)
    layers = [network.first, *network.head, network.last]
    return [_seen_by(partial(_path, layers[:depth]), _SIDE) for depth in range(1, len(layers) + 1)]


def field_of_network(samples: int) -> int:
    """Samples along an axis that the whole network sees, its U with it."""
    return _seen_by(_network(samples), _WHOLE_SIDE * samples // 4)


def _network(samples: int) -> PublishedUNet:
    """Return a network with the same weights at every call."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return PublishedUNet(samples, _CHANNELS)


def _path(layers: Sequence[torch.nn.Module], image: torch.Tensor) -> torch.Tensor:
    x = layers[0](image)
    for number, layer in enumerate(layers[1:]):
        x = layer(torch.cat([x, x], dim=1) if number == 0 else x)
    return torch.as_tensor(x)


def _seen_by(network: Callable[[torch.Tensor], torch.Tensor], side: int) -> int:
    image = torch.randn(1, 4, side, side, generator=torch.Generator().manual_seed(0)).requires_grad_()
    output = network(image)
    output[0, :, output.shape[-2] // 2, output.shape[-1] // 2].sum().backward()  # type: ignore[no-untyped-call]
    assert image.grad is not None
    columns = torch.nonzero(image.grad.abs().sum((0, 1, 2)) > 0).ravel()
    return int(columns.max() - columns.min()) + 1


def _cases(settings: Settings) -> list[Case]:
    return [{"name": "layers"}, *({"name": f"network-{samples}", "samples": samples} for samples in HEAD_STRIDES)]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    progress("gradients", 0.0)
    if case["name"] == "layers":
        return {"samples": field_of_layers()}
    return {"samples": field_of_network(case["samples"])}


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    seen = results[0]["samples"]
    rows: list[Row] = [
        (f"layer {number}", found, expected, found / 4)
        for number, (found, expected) in enumerate(zip(seen, EXPECTED, strict=True), 1)
    ]
    for case, result in zip(cases[1:], results[1:], strict=True):
        rows.append(
            (f"all, {case['samples']} samples a symbol", result["samples"], "-", result["samples"] / case["samples"])
        )
    return rows


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    layers = range(1, len(EXPECTED) + 1)
    axis.bar(layers, results[0]["samples"], color="tab:blue", label="measured")
    axis.plot(layers, EXPECTED, "k_", markersize=24, label="expected")
    axis.set_xlabel("layer at sample pitch")
    axis.set_ylabel("samples along an axis")
    right = axis.secondary_yaxis("right", functions=(partial(np.multiply, 1 / 4), partial(np.multiply, 4)))
    right.set_ylabel("symbols at 4 samples each")
    axis.legend()
    return figure


STUDY = Study(
    title="how far each layer of the published U-Net sees",
    source="table 3, corrected",
    cases=_cases,
    measure=_measure,
    header=("layer", "samples", "expected", "symbols"),
    rows=_rows,
    plot=_plot,
)
