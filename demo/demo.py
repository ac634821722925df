"""The main job on the simulated device: a picture goes through a service as bytes, while the device drifts.

Its bytes are encoded on pages in two groups, and one page is spoilt. The service reads them all from the simulated
device: as it was calibrated, after a drift that loses pages, and recalibrated.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.code import Code
from lightpage.codec.volume import Volume, encode_volume
from lightpage.codec.volume_file import Restored, VolumeFiles
from lightpage.demo.picture import picture
from lightpage.device.profile import Profile
from lightpage.device.state import CameraPose, Device
from lightpage.errors import InvalidInputError, LostPageError
from lightpage.metrics.information import achievable_rate
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pages import Pages, PagesWriter
from lightpage.runtime.archives.recordings.coded_pages import AIR_LEVELS
from lightpage.runtime.client.answers import Recalibrated, RemotePage
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.simulator import SimulatorSource
from lightpage.runtime.device.acquisition.source import FrameSource, open_source
from lightpage.runtime.device.modulator.simulated import SimulatedModulator
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.registry import ModelRegistry
from lightpage.runtime.service.server.server import LightpageServer

Floats = NDArray[np.float64]

GROUPS = 2
PARITY_PAGES = 2
SPOILT_PAGE = 1
"""Page whose symbols are damaged, of those that are written."""
SPOILT_SHARE = 0.4
"""Of its symbols: far more than its code mends."""

DRIFT_STEPS = (0.04, 0.06, 0.08, 0.1, 0.15, 0.3, 1.0)
"""Of the change of temperature of `drifted`; the first that loses a page ends the drift."""

RECALIBRATION_PAGES = 2


@dataclass(frozen=True)
class Phase:
    """What was decoded in one state of the device.

    Attributes:
        name: the state.
        model_version: the last page's.
        air: per data symbol, bits, mean over the pages that were decoded, [ny, nx]; not a number at pilots.
        confidence: mean over them, [ny, nx].
        symbol_error_rate: of data symbols.
        seconds: of one decode in the service, median.
        pages: that were read.
        unread: of them, how many gave no bytes.
        restored, lost: pages of the picture that parity gave back, and that are lost.
        margin_bits: least margin of the pages that gave bytes, bits a symbol; None where none did.
        picture: as it was read, lost bytes black, [rows, columns].
        exact: whether it is the picture that was written.
    """

    name: str
    model_version: str
    air: Floats
    confidence: Floats
    symbol_error_rate: float
    seconds: float
    pages: int = 0
    unread: int = 0
    restored: int = 0
    lost: int = 0
    margin_bits: float | None = None
    picture: NDArray[np.uint8] | None = None
    exact: bool = False

    @property
    def air_bits_per_symbol(self) -> float:
        """AIR over all data symbols."""
        return float(np.nanmean(self.air))

    def to_json(self) -> dict[str, Any]:
        """The figures under names that other programs read."""
        return {
            "name": self.name,
            "model_version": self.model_version,
            "air_bits_per_symbol": self.air_bits_per_symbol,
            "mean_confidence": float(self.confidence.mean()),
            "symbol_error_rate": self.symbol_error_rate,
            "seconds_per_page": self.seconds,
            "pages": self.pages,
            "pages_unread": self.unread,
            "pages_restored": self.restored,
            "pages_lost": self.lost,
            "margin_bits_least": self.margin_bits,
            "picture_exact": self.exact,
        }


@dataclass(frozen=True)
class DriftStep:
    """What one page told while the device drifted.

    Attributes:
        share: of the drift of `drifted`.
        margin_bits: of the page, bits a symbol; None where it was not decoded.
        recalibration_due: whether its pilots show the drift.
        lost: whether it gave no bytes.
    """

    share: float
    margin_bits: float | None
    recalibration_due: bool
    lost: bool


@dataclass(frozen=True)
class DemoResult:
    """All of the demo: three phases, the drift and the recalibration between them, and one frame pair with its page."""

    phases: tuple[Phase, ...]
    drift: tuple[DriftStep, ...]
    recalibrated: Recalibrated
    frames: FramePair
    symbols: NDArray[np.uint8]
    code: Code
    volume: Volume
    seed: int
    source: str = ""
    shots: dict[str, int] = field(default_factory=dict)
    """Shots of the cameras by how they ended; empty without cameras."""

    def to_json(self) -> dict[str, Any]:
        """The figures under names that other programs read."""
        recalibrated = self.recalibrated
        return {
            "seed": self.seed,
            "source": self.source,
            "shots": self.shots,
            "pages": self.volume.pages,
            "levels": self.code.levels,
            "air_levels": AIR_LEVELS,
            "code": self.code.model_dump(),
            "volume": self.volume.to_json(),
            "phases": [phase.to_json() for phase in self.phases],
            "drift": [asdict(step) for step in self.drift],
            "recalibration": {
                "model_version": recalibrated.model_version,
                "previous_version": recalibrated.previous_version,
                "pages_used": recalibrated.pages_used,
                "seconds": recalibrated.seconds,
                "angle_deg": recalibrated.angle_deg,
                "air_before": recalibrated.air_before,
                "air_after": recalibrated.air_after,
                "coherence_before": recalibrated.coherence_before,
                "coherence_after": recalibrated.coherence_after,
            },
        }


def drifted(device: Device, share: float = 1.0) -> Device:
    """The device after a change of temperature: more than following the image's shift can make good."""

    def moved(pose: CameraPose) -> CameraPose:
        return pose.model_copy(
            update={
                "scale_relative_error": pose.scale_relative_error + 5e-4 * share,
                "rotation_deg": pose.rotation_deg + 0.03 * share,
            }
        )

    geometry = device.geometry.model_copy(
        update={
            "pipe_angle_deg": device.geometry.pipe_angle_deg + 0.03 * share,
            "focal_length_relative_error": device.geometry.focal_length_relative_error + 3e-4 * share,
        }
    )
    return device.model_copy(
        update={
            "geometry": geometry,
            "in_phase_camera": moved(device.in_phase_camera),
            "quadrature_camera": moved(device.quadrature_camera),
        }
    )


def simulated_device(spec: str | None, profile: Profile, pages: Path) -> tuple[FrameSource, Callable[[Device], None]]:
    """A simulated device that shows these pages, and what lets it drift.

    Args:
        spec: ``camera:DEVICE.toml`` of a simulated device that runs as hardware; None for one in this process.
        profile: nominal.
        pages: file.

    Raises:
        InvalidInputError: a source that is no simulated device.
    """
    if spec is None:
        simulator = SimulatorSource(profile, Device(), written=Pages.open(pages))
        return simulator, simulator.set_device
    source = open_source(spec)
    modulator = source.modulator
    if not isinstance(modulator, SimulatedModulator):
        source.close()
        raise InvalidInputError(f"source {spec}", "no simulated device", "one of `lightpage virtual-device`")
    source.show_pages(PageStore(profile, Pages.open(pages)))
    return source, modulator.drift


def run_demo(
    bundle: Path,
    out: Path,
    seed: int,
    progress: Progress = lambda what, share: None,
    spec: str | None = None,
) -> DemoResult:
    """Write a picture and read it back in three states of the device, through a client of a service on this machine.

    Args:
        bundle: of the bench device, with a code.
        out: folder that exists, for the pages and the pictures.
        seed: of the volume's number and the damage: other pages are written.
        progress: told of every step, with the share of all that is done.
        spec: see `simulated_device`.

    Raises:
        LightpageError: an unusable bundle, or a recalibration that the service refuses.
    """
    progress("load the bundle", 0.0)
    decoder = Decoder.load(bundle)
    volume = write_pages(decoder, out / "pages.h5", seed)
    with ExitStack() as stack:
        source, drift = simulated_device(spec, decoder.bundle.profile, out / "pages.h5")
        stack.enter_context(source)
        plane = DataPlane(ModelRegistry(decoder, tracker_for), source)
        server = stack.enter_context(LightpageServer(plane, Recalibrator(plane), "127.0.0.1:0"))
        client = stack.enter_context(LightpageClient(server.target))
        frames = source.shot(source.shot_s, 0).pair
        levels = decoder.page_codec.code.levels
        symbols = client.decode(frames, levels).symbols

        def read(name: str, start: float, end: float) -> Phase:
            def told(share: float) -> None:
                progress(name, start + (end - start) * share)

            return read_picture(client, volume, out / f"{name.replace(' ', '-')}.pgm", name, told)

        fresh = read("as calibrated", 0.05, 0.3)
        steps = drift_until_lost(client, drift, lambda: progress("drift", 0.3))
        lost = read("after drift", 0.35, 0.6)
        recalibrated = client.recalibrate(
            pages=range(RECALIBRATION_PAGES),
            progress=lambda step, share: progress(f"recalibrate: {step}", 0.6 + 0.15 * share),
        )
        again = read("recalibrated", 0.75, 1.0)
    progress("done", 1.0)
    code = decoder.page_codec.code
    shots = dict(source.shots_by_outcome())
    phases = (fresh, lost, again)
    return DemoResult(phases, steps, recalibrated, frames, symbols, code, volume, seed, source.name, shots)


def write_pages(decoder: Decoder, path: Path, seed: int) -> Volume:
    """Put the picture on pages, one of them spoilt, and write them to `path`; returns how it lies there.

    Raises:
        BundleError: the bundle has no code.
    """
    codec, content = decoder.page_codec, pgm(picture())
    data = -(-len(content) // codec.user_bytes)
    volume = Volume.of_file(io.BytesIO(content), 1 + seed, codec.user_bytes, -(-data // GROUPS), PARITY_PAGES)
    profile, levels = decoder.bundle.profile, codec.code.levels
    rng = np.random.default_rng(seed)
    count = 0
    with PagesWriter(path, profile, levels, codec.code.model_dump() | volume.to_json()) as writer:
        for symbols in encode_volume(codec, volume, io.BytesIO(content), decoder.bundle.written_pilots(levels)):
            if count <= SPOILT_PAGE < count + len(symbols):
                spoilt = symbols[SPOILT_PAGE - count]
                damage = (rng.random(spoilt.shape) < SPOILT_SHARE) & ~codec.pilots
                spoilt[damage] = rng.integers(0, levels, int(damage.sum()))
            writer.append(symbols)
            count += len(symbols)
    return volume


def pgm(grey: NDArray[np.uint8]) -> bytes:
    """A grey picture [rows, columns] as a file in the portable graymap format."""
    rows, columns = grey.shape
    return f"P5 {columns} {rows} 255\n".encode() + grey.tobytes()


def drift_until_lost(
    client: LightpageClient, drift: Callable[[Device], None], told: Callable[[], None]
) -> tuple[DriftStep, ...]:
    """Let the device drift in steps, reading one page after each, until that page is lost."""
    steps: list[DriftStep] = []
    for share in DRIFT_STEPS:
        told()
        drift(drifted(Device(), share))
        try:
            page = client.read_page(0, user_data=True)
        except LostPageError as error:
            steps.append(DriftStep(share, None, error.recalibration_due, True))
            break
        found = page.user_data
        assert found is not None  # it was asked for
        steps.append(DriftStep(share, found.margin_bits, page.recalibration_due, found.data is None))
        if found.data is None:
            break
    return tuple(steps)


def read_picture(
    client: LightpageClient, volume: Volume, path: Path, name: str, told: Callable[[float], None]
) -> Phase:
    """Read all pages of the picture and put it together again, in `path`; what is lost of it is black there."""
    pages: list[RemotePage] = []
    unread = 0
    margins: list[float] = []
    with VolumeFiles(path) as files:
        for number in range(volume.pages):
            told(number / volume.pages)
            try:
                page = client.read_page(
                    number, user_data=True, want_concentration=True, want_phase=True, want_written=True
                )
            except LostPageError:
                unread += 1
                continue
            pages.append(page)
            if page.user_data is None or page.user_data.data is None:
                unread += 1
                continue
            files.add(page.user_data)
            margins.append(page.user_data.margin_bits)
        file = files.chosen()
        done = Restored((), ()) if file is None else file.restore()
        if file is not None:
            file.complete(done.lost)
    black = np.zeros_like(picture())
    if not margins:
        path.write_bytes(pgm(black))
    content, expected = path.read_bytes(), pgm(picture())
    grey = np.frombuffer(content[len(expected) - black.size :], np.uint8)
    return replace(
        summarise(name, pages) if pages else _nothing(name, client),
        pages=volume.pages,
        unread=unread,
        restored=len(done.restored),
        lost=len(done.lost) if margins else volume.file_pages,
        margin_bits=min(margins, default=None),
        picture=grey.reshape(black.shape),
        exact=content == expected,
    )


def _nothing(name: str, client: LightpageClient) -> Phase:
    """A state in which no page was decoded."""
    description = client.describe()
    air = np.where(description.pilot_mask, np.nan, 0.0)
    return Phase(name, description.model.version, air, np.zeros(description.page_shape), 1.0, float("nan"))


def summarise(name: str, pages: Sequence[RemotePage]) -> Phase:
    """Figures and maps of decoded pages that come with what was written, phase and concentration."""
    rates, errors = [], []
    for page in pages:
        if page.phase is None or page.concentration is None or page.written is None or page.pilot_mask is None:
            raise InvalidInputError(f"page {page.page}", "symbols alone", "phase, concentration and what was written")
        fine = page.written.astype(np.int64) * (AIR_LEVELS // page.levels)
        rate = achievable_rate(page.phase, page.concentration, fine, AIR_LEVELS)
        rates.append(np.where(page.pilot_mask, np.nan, rate))
        errors.append((page.symbols != page.written)[~page.pilot_mask])
    return Phase(
        name=name,
        model_version=pages[-1].model_version,
        air=np.mean(rates, axis=0),
        confidence=np.mean([page.confidence for page in pages], axis=0, dtype=np.float64),
        symbol_error_rate=float(np.mean(errors)),
        seconds=float(np.median([page.timings.decode_s for page in pages])),
    )
