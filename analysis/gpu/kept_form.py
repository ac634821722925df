"""Kept decoders in their batched form, and pages of their device to decode."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from analysis.comparison.data_set import LEVELS, data_set_of
from analysis.comparison.kept_weights import read_weights
from analysis.comparison.weight_store import CALIBRATION, KEPT_WEIGHTS
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.sampling_table import SamplingTable, sampling_table
from lightpage.device.profile import Profile
from lightpage.export.batched import batched_onnx
from lightpage.export.graph import DecoderGraph, table_tensors
from lightpage.metrics.information import achievable_rate
from lightpage.page.symbols import pilot_mask, random_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.train.fitting.validation import without_piston
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.presets import PRESETS
from lightpage.train.models.twin import RayTwin, TorchTwin

_METHODS = {"standard": "wave", "fast": "fast", "accurate": "coherent"}
"""Folders of kept methods by preset."""
_PAGES = 2
_SCALES = (0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0)
"""Factors on concentrations of which the best is taken, since kept weights come without theirs."""


@dataclass(frozen=True)
class Scene:
    """Pages of a kept data set's device.

    Attributes:
        profile, calibration: profile and calibration of the data set.
        pairs, symbols, references: simulated pages of its device.
    """

    profile: Profile
    calibration: Calibration
    pairs: list[FramePair]
    symbols: list[NDArray[np.uint8]]
    references: FramePair

    @cached_property
    def table(self) -> SamplingTable:
        """Table of the calibrated device."""
        twin, calibration = TorchTwin(RayTwin(self.profile)), self.calibration
        return sampling_table(twin, calibration.vector, calibration.turn_rad, self.profile)

    def air(self, p: NDArray[np.float32], page: int) -> float:
        """Achievable rate of an answer, bits a symbol."""
        mask = pilot_mask(self.profile)
        truth = symbol_phases(self.symbols[page], LEVELS).astype(np.float32)
        x, y = without_piston(p, truth, mask, LEVELS)[:, ~mask]
        phase, length, symbols = np.arctan2(y, x)[::3], np.hypot(x, y)[::3], self.symbols[page][~mask][::3]
        return max(float(achievable_rate(phase, scale * length, symbols, LEVELS).mean()) for scale in _SCALES)

    @staticmethod
    def deviation(expected: NDArray[np.float32], got: NDArray[np.float32]) -> float:
        """Return the error of p over its length, the 99th percentile of the symbols."""
        length = np.maximum(np.linalg.norm(expected, axis=0), np.finfo(np.float32).tiny)
        return float(np.percentile(np.linalg.norm(got - expected, axis=0) / length, 99))


@dataclass(frozen=True)
class Form:
    """A decoder in its batched form.

    Attributes:
        name: name of the preset.
        constants, batch: its two graphs, ONNX.
        defaults: its table.
        expected: what the form for one page says in float32, [2, ny, nx] of each page.
        told: figures of that form.
    """

    name: str
    constants: bytes
    batch: bytes
    defaults: dict[str, NDArray[Any]]
    expected: list[NDArray[np.float32]]
    told: dict[str, Any]
    frame_shape: tuple[int, int]
    page_shape: tuple[int, int]


def scene_of(folder: Path, out: Path) -> Scene:
    """Pages of the device of a kept data set, simulated once into a folder."""
    profile, device, seed = data_set_of(folder)
    path = out / f"pages-{profile.name}-{folder.name}.npy"
    symbols = list(random_symbols(profile, LEVELS, _PAGES, np.random.default_rng(seed + 1)))
    if not path.exists():
        simulator = Simulator(profile, device, seed=seed + 1)
        pairs = [simulator.page(each) for each in symbols]
        references = simulator.references()
        frames = [frame for pair in (*pairs, references) for frame in (pair.in_phase, pair.quadrature)]
        np.save(path, np.stack(frames))
    frames = list(np.load(path))
    made = [FramePair(*frames[number : number + 2]) for number in range(0, len(frames), 2)]
    return Scene(profile, load_calibration(folder / CALIBRATION), made[:-1], symbols, made[-1])


def kept_decoder(folder: Path, preset: str, scene: Scene, reflections: int) -> SymbolDecoder:
    """The kept decoder of a preset; the light that a second pass expects is even."""
    method = next(iter(sorted((folder / _METHODS[preset]).glob("*"))))
    usual = PRESETS[preset]
    choices = replace(usual.choices, reflections=reflections if usual.choices.reflections else 0)
    decoder = SymbolDecoder(scene.profile, scene.calibration.vector, usual.localizer, choices)
    decoder.network.load_state_dict(read_weights(method / KEPT_WEIGHTS))
    for number, refiner in enumerate(decoder.refiners):
        refiner.load_state_dict(read_weights(method / f"refinement-{number + 1}" / KEPT_WEIGHTS))
    return decoder.float().eval()


def form_of(folder: Path, scene: Scene, preset: str, reflections: int, device: torch.device) -> Form:
    """A kept decoder in its batched form.

    Args:
        folder, scene: folder and scene of the data set.
        preset: which.
        reflections: rounds to the field; 0 for descent.
        device: what the form for one page is run on, which tells what is expected.
    """
    profile = scene.profile
    graph = DecoderGraph(profile, kept_decoder(folder, preset, scene, reflections), 1.0).eval()
    defaults = table_tensors(graph, scene.table, scene.references)
    start = time.perf_counter()
    made = batched_onnx(graph, "uint8", defaults, torch.float16)
    assert made is not None
    exported = time.perf_counter() - start
    expected, taken = [], []
    with torch.no_grad():
        graph = graph.to(device)
        tensors = [torch.from_numpy(np.ascontiguousarray(value)).to(device) for value in defaults.values()]
        for pair in scene.pairs:
            frames = [torch.from_numpy(frame).to(device) for frame in (pair.in_phase, pair.quadrature)]
            start = time.perf_counter()
            expected.append(graph(*frames, *tensors)[0].cpu().numpy())
            taken.append(time.perf_counter() - start)
    told = {
        "air": [scene.air(p, page) for page, p in enumerate(expected)],
        "torch_ms": 1e3 * taken[-1],
        "export_s": exported,
    }
    return Form(preset, *made, defaults, expected, told, profile.frame_shape, profile.page_shape)
