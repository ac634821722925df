"""Time and memory of decoding against the number of symbols: transmission matrix, modes, coherent branches."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from lightpage.calibration.parameters import nominal
from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.profile import Profile
from lightpage.progress import Progress
from lightpage.study.study import Case, Result, Row, Settings, Study
from lightpage.train.models.field import FieldRecovery
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.localizers.coherent import CoherentLocalizer
from lightpage.train.models.network import SymbolUNet
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.published.localizers import ModeLocalizer
from lightpage.train.published.unet import samples_for

_ENLARGED = (1, 2, 4, 8)
"""Linear sizes over the profile's: with bench, 5,000 to 312,000 symbols."""
_MOST_SYMBOLS = 400_000
"""Number of symbols of the largest page."""
_MOST_BYTES = 4 << 30
"""A transmission matrix beyond that is not made: its time is extrapolated from one of that size."""
_ENTRY_BYTES = 8
_REPEATS = 3
METHODS = ("matrix", "modes", "coherent")
_EXPECTED = {"matrix": 2.0, "modes": 1.5, "coherent": 1.0}
"""Powers of the number of symbols."""
_TIMED = {"matrix": "its product alone", "modes": "its localizer alone", "coherent": "frames to estimates"}


def enlarged(profile: Profile, factor: int) -> Profile:
    """The device with all lengths but pixels and wavelength multiplied: page, pipe, lenses, cameras grow together."""
    return profile.model_copy(
        update={
            "name": f"{profile.name} x {factor}",
            "lens": profile.lens.model_copy(update={"focal_length_m": factor * profile.lens.focal_length_m}),
            "pipe": profile.pipe.model_copy(
                update={"length_m": factor * profile.pipe.length_m, "width_m": factor * profile.pipe.width_m}
            ),
            "page": profile.page.model_copy(
                update={"columns": factor * profile.page.columns, "rows": factor * profile.page.rows}
            ),
            "lens_path": profile.lens_path.times(factor),
            "camera": profile.camera.model_copy(
                update={
                    "columns_px": factor * profile.camera.columns_px,
                    "rows_px": factor * profile.camera.rows_px,
                }
            ),
        }
    )


def _matrix(profile: Profile) -> tuple[Callable[[], object], int]:
    count = min(_symbols(profile), math.isqrt(_MOST_BYTES // _ENTRY_BYTES))
    matrix = torch.zeros(count, count, dtype=torch.complex64)
    light = torch.randn(count, dtype=torch.complex64)
    return lambda: matrix @ light, _ENTRY_BYTES * _symbols(profile) ** 2


def _modes(profile: Profile) -> tuple[Callable[[], object], int]:
    samples = samples_for(profile.page.symbol_size_px)
    localizer = ModeLocalizer(profile, samples)
    seen = torch.randn(1, 2, *localizer.places.shape[:2])
    return lambda: localizer(seen), _bytes((localizer.x, localizer.y, localizer.pipe))


def _coherent(profile: Profile) -> tuple[Callable[[], object], int]:
    table = sampling_table(TorchTwin(RayTwin(profile)), nominal(), np.pi / 2, profile)
    tensors = {name: torch.from_numpy(value) for name, value in table.items()}
    recovery, localizer = FieldRecovery(profile).eval(), CoherentLocalizer(profile).eval()
    choices = Hyperparameters()
    network = SymbolUNet(localizer.light_channels, choices.channels, choices.blocks, choices.depth).eval()
    reference = torch.full(profile.frame_shape, 100.0)
    generator = torch.Generator().manual_seed(0)
    frames = [reference + 20 * torch.randn(profile.frame_shape, generator=generator) for _ in range(2)]

    def decode() -> object:
        field, _ = recovery(*frames, reference, reference, tensors["registration"], tensors["homodyne"])
        light = localizer(field, tensors["places"], tensors["place_gradients"], tensors["phases"])
        return network(light.flatten(0, 2)[None], tensors["positions"][None])

    return decode, _bytes((*tensors.values(), *network.parameters()))


def _symbols(profile: Profile) -> int:
    return profile.page.columns * profile.page.rows


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum(tensor.nbytes for tensor in tensors)


_MAKERS = {"matrix": _matrix, "modes": _modes, "coherent": _coherent}


def _cases(settings: Settings) -> list[Case]:
    factors = [factor for factor in _ENLARGED if factor**2 * _symbols(settings.profile) <= _MOST_SYMBOLS] or [1]
    if settings.quick:
        factors = factors[:2]
    return [
        {"name": f"{method}-{factor}", "method": method, "factor": factor} for method in METHODS for factor in factors
    ]


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    profile = enlarged(settings.profile, case["factor"])
    progress("prepare", 0.0)
    with torch.inference_mode():
        run, size = _MAKERS[case["method"]](profile)
        run()
        seconds = []
        for repeat in range(_REPEATS):
            progress("time", repeat / _REPEATS)
            start = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - start)
    larger = max(1.0, size / _MOST_BYTES) if case["method"] == "matrix" else 1.0
    return {
        "symbols": _symbols(profile),
        "seconds": larger * min(seconds),
        "bytes": size,
        "how": "measured" if larger == 1 else "extrapolated",
    }


def _of(method: str, cases: Sequence[Case], results: Sequence[Result]) -> list[Result]:
    return [result for case, result in zip(cases, results, strict=True) if case["method"] == method]


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    rows: list[Row] = []
    for method in METHODS:
        chosen = _of(method, cases, results)
        first = chosen[0]["seconds"] / chosen[0]["symbols"]
        for result in chosen:
            taken, each = result["seconds"], result["seconds"] / result["symbols"]
            size, how = result["bytes"] / 1e6, result["how"]
            rows.append((method, result["symbols"], taken, 1e6 * each, each / first, size, how))
    return rows


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    time_axis, memory_axis = figure.subplots(1, 2)
    for method, colour in zip(METHODS, ("tab:red", "tab:orange", "tab:blue"), strict=True):
        chosen = _of(method, cases, results)
        symbols, seconds = ([result[name] for result in chosen] for name in ("symbols", "seconds"))
        label = f"{method}: {_TIMED[method]}; power {_EXPECTED[method]:g} expected"
        time_axis.loglog(symbols, seconds, color=colour, label=label)
        for axis, values in ((time_axis, seconds), (memory_axis, [result["bytes"] / 1e6 for result in chosen])):
            for x, y, result in zip(symbols, values, chosen, strict=True):
                axis.plot(x, y, "o", color=colour, fillstyle="full" if result["how"] == "measured" else "none")
        memory_axis.loglog(symbols, [result["bytes"] / 1e6 for result in chosen], color=colour, label=method)
    time_axis.set_ylabel("seconds a page, in torch (open: extrapolated)")
    memory_axis.set_ylabel("what the decoder holds of the device, MB")
    for axis in (time_axis, memory_axis):
        axis.set_xlabel("symbols on a page")
        axis.grid(alpha=0.3)
        axis.legend(loc="lower left", bbox_to_anchor=(0, 1))
    return figure


STUDY = Study(
    title="time and memory against the number of symbols",
    source="the scaling that its introduction argues with",
    cases=_cases,
    measure=_measure,
    header=("decoder", "symbols", "seconds", "us a symbol", "over the smallest", "MB", ""),
    rows=_rows,
    plot=_plot,
)
