"""A tiny device and its ONNX decoder, for tests of the runtime: every symbol is the mean of a 4x4 block of pixels.

in-phase = 128 + 70 cos(theta), quadrature = 80 + 70 sin(theta), so that swapped frames contradict the references.
"""

import threading
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import numpy_helper

from lightpage.device.profile import Camera, PageLayout, Profile, load_profile
from lightpage.errors import CalibrationError
from lightpage.page.levels import Levels
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import DECODER, GOLDEN, PILOTS, TWIN, Manifest
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RefitReport, RefitResult
from tests.lightpage.small import EXPLAINED

PROFILE: Profile = load_profile("bench").model_copy(
    update={
        "name": "toy",
        "page": PageLayout(columns=24, rows=16, symbol_size_px=4, pilot_fraction=0.05),
        "camera": Camera(columns_px=96, rows_px=64, pitch_m=2.4e-6),
    }
)
PROFILE_TOML = PROFILE.to_toml()
SHAPE = PROFILE.frame_shape
PAGE = PROFILE.page_shape
OFFSETS = (128.0, 80.0)
AMPLITUDE = 70.0
TABLE_INPUTS = ("reference_in_phase", "reference_quadrature", "homodyne")


@dataclass
class ToyDevice:
    """What may drift: the offsets of both cameras, the noise of a pixel."""

    offsets: tuple[float, float] = OFFSETS
    noise: float = 12.0
    seed: int = 0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def page(self, symbols: np.ndarray, levels: int | Levels, piston: float = 0.0) -> FramePair:
        phase = np.kron(symbol_phases(symbols, levels) + piston, np.ones((4, 4)))
        frames = []
        for offset, wave in zip(self.offsets, (np.cos(phase), np.sin(phase)), strict=True):
            counts = offset + AMPLITUDE * wave + self.noise * self.rng.standard_normal(SHAPE)
            frames.append(np.clip(np.rint(counts), 0, 254).astype(np.uint8))
        return FramePair(*frames)

    def references(self) -> FramePair:
        return FramePair(*(np.full(SHAPE, offset, np.uint8) for offset in self.offsets))


def symbols_of(levels: int, seed: int, pages: int = 1) -> np.ndarray:
    """[page, ny, nx] with the pilots in place."""
    return random_symbols(PROFILE, levels, pages, np.random.default_rng(seed))


_DECODER = Template("""
<ir_version: 10, opset_import: ["" : 18]>
toy ($frame[$h, $w] in_phase, $frame[$h, $w] quadrature, float[$h, $w] reference_in_phase,
     float[$h, $w] reference_quadrature, float[2] homodyne)
  => (float[2, $ny, $nx] p, float[$ny, $nx] phase, float[$ny, $nx] concentration, float residual)
<int64[2] both_axes = {0, 1}, int64[1] axis = {0}, int64 first = {0}, int64 second = {1}, float small = {1e-3},
 float tiny = {1e-9}>
{
  i = Cast<to = 1>(in_phase)
  i_seen = Sub(i, reference_in_phase)
  i_deep = Unsqueeze(i_seen, both_axes)
  i_mean = AveragePool<kernel_shape = [4, 4], strides = [4, 4]>(i_deep)
  x = Squeeze(i_mean, axis)
  q = Cast<to = 1>(quadrature)
  q_seen = Sub(q, reference_quadrature)
  q_deep = Unsqueeze(q_seen, both_axes)
  q_mean = AveragePool<kernel_shape = [4, 4], strides = [4, 4]>(q_deep)
  y = Squeeze(q_mean, axis)
  gain = Gather(homodyne, first)
  q_gain = Gather(homodyne, second)
  y_scaled = Mul(y, q_gain)
  both = Concat<axis = 0>(x, y_scaled)
  p = Mul(both, gain)
  px_deep, py_deep = Split<axis = 0, num_outputs = 2>(p)
  px = Squeeze(px_deep, axis)
  py = Squeeze(py_deep, axis)
  px2 = Mul(px, px)
  py2 = Mul(py, py)
  sum2 = Add(px2, py2)
  concentration = Sqrt(sum2)
  size = Abs(py)
  vanishes = Less(size, small)
  rise = Where(vanishes, small, py)
  along = Add(concentration, px)
  safe = Max(along, tiny)
  half_tangent = Div(rise, safe)
  half_angle = Atan(half_tangent)
  phase = Add(half_angle, half_angle)
  mean = ReduceMean<keepdims = 0>(concentration)
  deviation = Sub(concentration, mean)
  deviation2 = Mul(deviation, deviation)
  variance = ReduceMean<keepdims = 0>(deviation2)
  spread = Sqrt(variance)
  residual = Div(spread, mean)
}""")
"""atan2(y, x) = 2 atan(y / (|p| + x)), with y kept off zero, where x < 0 would give 0 / 0."""


def decoder_onnx(kappa: float = 400.0, shape: tuple[int, int] = SHAPE, frame_type: str = "uint8") -> bytes:
    """The toy decoder; `kappa` is the concentration it claims at full amplitude."""
    h, w = shape
    tables = {
        "reference_in_phase": np.full(shape, OFFSETS[0], np.float32),
        "reference_quadrature": np.full(shape, OFFSETS[1], np.float32),
        "homodyne": np.array([kappa / AMPLITUDE, 1.0], np.float32),
    }
    model = onnx.parser.parse_model(_DECODER.substitute(frame=frame_type, h=h, w=w, ny=h // 4, nx=w // 4))
    model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in tables.items())
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


_TWIN = """
<ir_version: 10, opset_import: ["" : 18]>
twin (double[3] parameters, double[n, 2] points) => (double[n, 2] places) <int64[2] indices = {0, 1}>
{ shift = Gather(parameters, indices) places = Add(points, shift) }"""


def twin_onnx() -> bytes:
    """places = points + the first two parameters."""
    return bytes(onnx.parser.parse_model(_TWIN).SerializeToString())


def expected_p(pair: FramePair, kappa: float = 400.0, offsets: tuple[float, float] = OFFSETS) -> np.ndarray:
    """What the toy decoder must answer, by numpy."""
    ny, nx = PAGE
    return np.stack(
        [
            (frame.astype(np.float64) - offset).reshape(ny, 4, nx, 4).mean((1, 3)) * kappa / AMPLITUDE
            for frame, offset in zip((pair.in_phase, pair.quadrature), offsets, strict=True)
        ]
    ).astype(np.float32)


def manifest(**changes: object) -> Manifest:
    return Manifest(
        **{
            "name": "toy",
            "version": "toy-1",
            "created": "2026-01-01T00:00:00Z",
            "profile": PROFILE.to_toml(),
            "calibration": "angle_deg = 0.0\n",
            "camera_bit_depth": 8,
            "frame_dtype": "uint8",
            "table_inputs": TABLE_INPUTS,
            "residual_output": "residual",
            "residual_limit": 0.4,
            **changes,
        }
    )


def files(kappa: float = 400.0) -> dict[str, bytes]:
    """The files of a sound toy bundle."""
    pair = ToyDevice(seed=99).page(symbols_of(16, 99)[0], 16)
    golden = npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=expected_p(pair, kappa))
    return {DECODER: decoder_onnx(kappa), TWIN: twin_onnx(), GOLDEN: golden}


OWN_MASK = np.zeros(PAGE, bool)
OWN_MASK[1::4, 2::5] = True
OWN_PHASES = np.random.default_rng(77).uniform(-np.pi, np.pi, np.count_nonzero(OWN_MASK)).astype(np.float32)


def own_pilots_page(device: ToyDevice, symbols: np.ndarray, levels: int, piston: float) -> FramePair:
    """A page whose pilots are the fixed phases OWN_PHASES at OWN_MASK, of no level count."""
    places = symbols.astype(np.float64)
    places[OWN_MASK] = OWN_PHASES * levels / (2 * np.pi)
    return device.page(places, levels, piston)


def write_own_pilots_bundle(path: Path, **pilots: np.ndarray) -> Path:
    """A toy bundle whose device has pilots of its own, or the given arrays in their place."""
    arrays = pilots or {"mask": OWN_MASK, "phases": OWN_PHASES}
    return write_bundle(path, manifest(), files() | {PILOTS: npz(**arrays)})


def write_toy_bundle(path: Path, kappa: float = 400.0, **changes: object) -> Path:
    return write_bundle(path, manifest(**changes), files(kappa))


def write_toy_recording(
    path: Path, device: ToyDevice, levels: int, pages: int, seed: int = 7, piston: float = 0.4
) -> np.ndarray:
    """Write a recording and return its symbols."""
    symbols = symbols_of(levels, seed, pages)
    with RecordingWriter(path, PROFILE, levels, 8, device.references()) as writer:
        for index, page in enumerate(symbols):
            writer.append(page, device.page(page, levels, piston * index))
    return symbols


def frames_fail(monkeypatch: pytest.MonkeyPatch, error: Exception, *pages: int, of: str = "") -> None:
    """Have the frames of some pages of recordings, of one name or all, not be read."""
    frames = Recording.frames

    def read(recording: Recording, page: int) -> FramePair:
        if page in pages and recording.path.name.startswith(of):
            raise error
        return frames(recording, page)

    monkeypatch.setattr(Recording, "frames", read)


def fit_references(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
    """A fit for the toy device: its geometry is the offset of each camera, read from the reference frames."""
    progress("fit", 0.5)
    if pages.references is None:
        raise CalibrationError("toy fit", "no references", "reference frames")
    table = {
        "reference_in_phase": pages.references.in_phase.astype(np.float32),
        "reference_quadrature": pages.references.quadrature.astype(np.float32),
    }
    return RefitResult(table, "angle_deg = 0.5\n", RefitReport(0.5, 0.4, 0.9, goodness=EXPLAINED))


class ToySource(FrameSource):
    """A source of toy pages whose device may drift; `asked` has the pages asked for, `shown` those that were shown."""

    name = "toy:device"
    bit_depth = 8
    frame_shape = SHAPE

    def __init__(self, device: ToyDevice, levels: int = 16, pages: int | None = None) -> None:
        self.device, self.levels, self.pages = device, levels, pages
        self.asked: list[int | None] = []
        self.shown: list[int] = []
        self._next, self._lock = 0, threading.Lock()

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        with self._lock:
            self.asked.append(page)
            if page is None:
                page, self._next = self._next, self._next + 1
            self.shown.append(page)
            symbols = symbols_of(self.levels, page)[0]
            return Shot(self.device.page(symbols, self.levels, 0.1 * page), page, symbols)

    def references(self) -> FramePair:
        return self.device.references()
