"""Measures what a camera's driver delivers: to the byte, without old frames, how fast, beside other threads.

Pairs a second over the whole chain are compared with the cameras alone, fired as fast as their frames come, and with
pairing alone, over cameras that deliver in no time.

    python -m analysis.hardware.cameras --json runs/cameras.json

Fake cameras send real GigE Vision packets over loopback. Runs in a private network.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.errors import LostShotError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.layout import FrameInfo, frame_type
from lightpage.runtime.device.acquisition.camera_source import CameraSource, Exposures
from lightpage.runtime.device.acquisition.pairing import PairingSettings
from lightpage.runtime.device.cameras.aravis import AravisCamera
from lightpage.runtime.device.cameras.camera import BrokenFrame, Camera, Frame
from lightpage.runtime.device.cameras.pixel_formats import bit_depth, unpack
from lightpage.runtime.device.cameras.settings import CameraSettings
from lightpage.runtime.device.modulator.modulator import OperatorBeams
from lightpage.runtime.device.trigger.trigger import SoftwareTrigger, Trigger
from lightpage.virtual_device.fake_camera import FakeCamera
from lightpage.virtual_device.namespace import ADDRESSES, go_on_inside
from lightpage.virtual_device.packing import pack

Counts = NDArray[np.unsignedinteger[Any]]

FORMATS = ("Mono8", "Mono12", "Mono12p", "Mono12Packed")
PACKETS_BYTES = (1400, 9000, 60_000)
TOLERANCES_S = (0.02, 0.01)
"""Tolerances of the pairing; shots are at least 2.5 tolerances apart."""
_SMALL = (256, 320)
FULL = (2048, 2048)
_CHAIN = 4
"""Times as many shots of the whole chain: a lost one costs as much as ten others."""
_TRIES = 10
"""Tries of the first shot, until the cameras' clocks are known."""
_FRAME_S = 2.0
_FREE_RUN_S = 0.004
_LEFTOVERS = 5
"""Frames of a free run that come before a trigger."""
_TICK_S = 1e-3
_PAGES = 5
"""Different pages that are shown in turn."""
_UNPACKED = 21
"""Frames whose unpacking is timed, per format."""


class Eye:
    """Frames that one fake camera sees."""

    def __init__(self, image: Counts) -> None:
        self.image = image

    def look(self) -> Counts:
        """The sensor as it is now."""
        return self.image


@contextmanager
def cameras(
    shape: tuple[int, int], pixel_format: str, packet_bytes: int, count: int = 2
) -> Iterator[list[tuple[FakeCamera, AravisCamera, Eye]]]:
    """Fake cameras with their drivers, armed for edges on a line."""
    made: list[tuple[FakeCamera, AravisCamera, Eye]] = []
    try:
        for number, address in enumerate(ADDRESSES[:count]):
            eye = Eye(np.zeros(shape, frame_type(bit_depth(pixel_format))))
            settings = CameraSettings(
                address=address, pixel_format=pixel_format, packet_bytes=packet_bytes, trigger_source="Line1"
            )
            made.append((FakeCamera(address, f"FAKE-{number}", eye.look, shape), AravisCamera(settings, shape), eye))
        for _, camera, _ in made:
            camera.arm()
        yield made
    finally:
        for fake, camera, _ in made:
            camera.close()
            fake.close()


def stale_frames(changes: int) -> dict[str, int]:
    """Change from a free run to the trigger; a triggered frame that shows what was before its trigger is stale."""
    stale = missing = 0
    with cameras(_SMALL, "Mono8", 9000, 1) as ((fake, camera, eye),):
        for change in track(range(changes), "free run to trigger", total=changes):
            eye.image = np.zeros(_SMALL, np.uint8)
            before = camera.whole_frames
            fake.run_freely(_FREE_RUN_S)
            end = time.monotonic() + _FRAME_S
            while camera.whole_frames < before + _LEFTOVERS and time.monotonic() < end:
                time.sleep(_FREE_RUN_S)
            camera.arm()
            number = change % 255 + 1
            eye.image = np.full(_SMALL, number, np.uint8)
            fired_s = time.time()  # the fake camera's clock is this machine's
            fake.edge()
            frame = camera.frame(_FRAME_S)
            if not isinstance(frame, Frame):
                missing += 1
            else:
                stale += bool((frame.pixels != number).any()) or frame.info.device_time_s < fired_s - _TICK_S
            fake.check()
    return {"changes": changes, "stale": stale, "missing": missing}


def take(stage: list[tuple[FakeCamera, AravisCamera, Eye]]) -> list[Frame | BrokenFrame | None]:
    """Fire one edge to all cameras, and return a frame of each."""
    for fake, _, _ in stage:
        fake.edge()
    return [camera.frame(_FRAME_S) for _, camera, _ in stage]


def equal_frames(pairs: int, pixel_format: str) -> dict[str, int]:
    """Pairs of frames full of noise, compared with what was sent."""
    random, depth = np.random.default_rng(0), bit_depth(pixel_format)
    equal = incomplete = other = 0
    with cameras(_SMALL, pixel_format, 9000) as stage:
        for _ in track(range(pairs), pixel_format, total=pairs):
            for _, _, eye in stage:
                eye.image = random.integers(0, 2**depth, _SMALL, dtype=frame_type(depth))
            for frame, (fake, _, eye) in zip(take(stage), stage, strict=True):
                fake.check()
                if not isinstance(frame, Frame):
                    incomplete += 1
                elif (frame.pixels == eye.image).all():
                    equal += 1
                else:
                    other += 1
    return {"frames": 2 * pairs, "equal": equal, "other": other, "incomplete": incomplete}


class Ticks:
    """A thread that wants to run every millisecond, and how long it really took."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._ticks_s: list[float] = []
        self._thread = threading.Thread(target=self._run, name="ticks", daemon=True)

    def __enter__(self) -> Ticks:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._stop.is_set():
            time.sleep(_TICK_S)
            now = time.perf_counter()
            self._ticks_s.append(now - last)
            last = now

    def figures(self) -> dict[str, float]:
        """Milliseconds."""
        p50, p99, largest = 1e3 * np.quantile(self._ticks_s, [0.5, 0.99, 1.0])
        return {"p50_ms": float(p50), "p99_ms": float(p99), "max_ms": float(largest)}


def speed(shots: int, packet_bytes: int) -> dict[str, Any]:
    """Shots in a row of two cameras at full size, and another thread's ticks meanwhile.

    Every shot shows other pages than the last one, and is compared with them; that is not timed.
    """
    random = np.random.default_rng(0)
    pages = [random.integers(0, 256, FULL, dtype=np.uint8) for _ in range(_PAGES)]
    with cameras(FULL, "Mono8", packet_bytes) as stage:
        take(stage)  # the first frame of a fake camera is late
        equal, seconds = 0, 0.0
        with Ticks() as ticks:
            for shot in track(range(shots), f"packets of {packet_bytes} B", total=shots):
                for number, (_, _, eye) in enumerate(stage):
                    eye.image = pages[(shot + 2 * number) % _PAGES]
                started = time.perf_counter()
                frames = take(stage)
                seconds += time.perf_counter() - started
                equal += all(
                    isinstance(frame, Frame) and (frame.pixels == eye.image).all()
                    for frame, (_, _, eye) in zip(frames, stage, strict=True)
                )
        return {
            "packet_bytes": packet_bytes,
            "shots": shots,
            "equal": equal,
            "equal_per_s": equal / seconds,
            "tick": ticks.figures(),
        }


class InstantCamera:
    """A camera that delivers a copy of its picture in no time: see `Camera`."""

    name, frame_shape, bit_depth, frame_numbers, opened = "camera", FULL, 8, 2**64 - 1, 1

    def __init__(self, image: Counts) -> None:
        self._image, self._number, self._ready = image, 0, list[Frame]()

    def fire(self) -> None:
        """Make a frame."""
        self._number += 1
        info = FrameInfo("INSTANT", self._number, time.monotonic(), time.time(), "Mono8")
        self._ready.append(Frame(self._image.copy(), info))

    def frame(self, timeout_s: float) -> Frame | None:
        """The next one."""
        return self._ready.pop(0) if self._ready else None

    def arm(self) -> None:
        """Do nothing: the camera needs no arming."""

    disarm = close = arm


class Edges:
    """A trigger whose line goes to fake cameras: see `Trigger`."""

    name = "edges"

    def __init__(self, fakes: Sequence[FakeCamera]) -> None:
        self._fakes = fakes

    def fire(self) -> float:
        """Fire one edge to all."""
        fired = time.monotonic()
        for fake in self._fakes:
            fake.edge()
        return fired

    def arm(self) -> None:
        """Do nothing: the cameras need no arming."""

    disarm = close = arm


def pairs_per_s(
    cameras: tuple[Camera, Camera], trigger: Trigger, settings: PairingSettings, shots: int
) -> tuple[float, int]:
    """Pairs a second from a source without a modulator, ready to be decoded, and lost shots, whose time counts too."""
    profile = load_profile("bench")
    camera = profile.camera.model_copy(update={"rows_px": FULL[0], "columns_px": FULL[1]})
    profile = profile.model_copy(update={"camera": camera})
    exposures = Exposures(repeats=0)
    with CameraSource(
        profile, cameras, trigger, None, OperatorBeams(click.echo), pairing=settings, exposures=exposures
    ) as source:
        for _ in range(_TRIES):
            with suppress(LostShotError):
                source.shot()  # synchronises
                break
        taken, started = 0, time.perf_counter()
        for _ in track(range(shots), "pairs", total=shots):
            with suppress(LostShotError):
                source.shot()
                taken += 1
        return taken / (time.perf_counter() - started), shots - taken


def chain(shots: int, packet_bytes: int, tolerance_s: float) -> dict[str, float]:
    """Pairs a second over everything, over the slower of its two halves; one after the other, in one run."""
    random = np.random.default_rng(0)
    first, second = (random.integers(0, 200, FULL, dtype=np.uint8) for _ in range(2))
    settings = PairingSettings(tolerance_s=tolerance_s, spacing_s=2.5 * tolerance_s)
    instant = (InstantCamera(first), InstantCamera(second))
    pairing_alone, _ = pairs_per_s(instant, SoftwareTrigger(instant), settings, shots)
    with cameras(FULL, "Mono8", packet_bytes) as stage:
        for (_, _, eye), image in zip(stage, (first, second), strict=True):
            eye.image = image
        take(stage)  # the first frame of a fake camera is late
        started = time.perf_counter()
        whole = sum(all(isinstance(frame, Frame) for frame in take(stage)) for _ in range(shots))
        cameras_alone = whole / (time.perf_counter() - started)
        pair = stage[0][1], stage[1][1]
        together, lost = pairs_per_s(pair, Edges([fake for fake, _, _ in stage]), settings, shots)
    return {
        "packet_bytes": packet_bytes,
        "tolerance_s": tolerance_s,
        "cameras_alone_per_s": cameras_alone,
        "pairing_alone_per_s": pairing_alone,
        "pairs_per_s": together,
        "shots": shots,
        "lost": lost,
        "ratio": together / min(cameras_alone, pairing_alone),
    }


def idle_ticks(seconds: float) -> dict[str, float]:
    """The ticks of a thread while nothing else is done."""
    with Ticks() as ticks:
        time.sleep(seconds)
    return ticks.figures()


def plain_unpack_12p(raw: NDArray[np.uint8]) -> Counts:
    """Mono12p byte by byte, as anybody would write it first: what `unpack` is compared with."""
    first, middle, last = raw.reshape(-1, 3).astype(np.uint16).T
    counts = np.empty((first.size, 2), np.uint16)
    counts[:, 0] = first | (middle & 15) << 8
    counts[:, 1] = middle >> 4 | last << 4
    return counts.reshape(FULL)


def unpacking(pixel_format: str, work: Callable[[NDArray[np.uint8]], Counts] | None = None) -> float:
    """Milliseconds to unpack a frame at full size, median. The frames are kept, so each needs new memory."""
    depth = bit_depth(pixel_format)
    image = np.random.default_rng(0).integers(0, 2**depth, FULL, dtype=frame_type(depth))
    raw = pack(image, pixel_format)
    taken, kept = [], []
    for _ in range(_UNPACKED):
        started = time.perf_counter()
        kept.append(unpack(raw, FULL, pixel_format) if work is None else work(raw))
        taken.append(time.perf_counter() - started)
    assert all((counts == image).all() for counts in kept)
    return 1e3 * float(np.median(taken))


def told(tick: dict[str, float]) -> str:
    """Ticks for people."""
    return f"tick of 1 ms: p50 {tick['p50_ms']:.2f}, p99 {tick['p99_ms']:.2f}, max {tick['max_ms']:.1f} ms"


@click.command()
@click.option("--changes", default=200, show_default=True, type=click.IntRange(1, 100_000), help="Free run to trigger.")
@click.option(
    "--pairs", default=100, show_default=True, type=click.IntRange(1, 100_000), help="Pairs of each pixel format."
)
@click.option(
    "--shots", default=60, show_default=True, type=click.IntRange(1, 100_000), help="Shots of each packet size."
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(changes: int, pairs: int, shots: int, json_path: Path | None) -> None:
    """Print stale frames, frames that are equal to the byte, shots per second, another thread's ticks, unpacking."""
    go_on_inside("analysis.hardware.cameras")
    stale = stale_frames(changes)
    click.echo(f"stale frames: {stale['stale']} after {changes} changes to the trigger, {stale['missing']} missing")
    equal = {name: equal_frames(pairs, name) for name in FORMATS}
    for name, found in equal.items():
        click.echo(
            f"{name}: {found['equal']} of {found['frames']} frames equal, {found['other']} different, "
            f"{found['incomplete']} incomplete"
        )
    idle = idle_ticks(3.0)
    click.echo(f"nothing to do: {told(idle)}")
    speeds = [speed(shots, size) for size in PACKETS_BYTES]
    for fast in speeds:
        click.echo(
            f"packets of {fast['packet_bytes']} B: {fast['equal_per_s']:.1f} shots/s, {fast['equal']} of {shots} "
            f"equal, {told(fast['tick'])}"
        )
    chains = [chain(_CHAIN * shots, size, tolerance) for size in PACKETS_BYTES for tolerance in TOLERANCES_S]
    for each in chains:
        click.echo(
            f"pairs of 2048 x 2048, packets of {each['packet_bytes']} B, tolerance {1e3 * each['tolerance_s']:g} ms: "
            f"{each['pairs_per_s']:.1f}/s; cameras alone {each['cameras_alone_per_s']:.1f}, pairing alone "
            f"{each['pairing_alone_per_s']:.1f}; ratio {each['ratio']:.2f}, "
            f"{each['lost']} of {each['shots']} shots lost"
        )
    unpack_ms = {name: unpacking(name) for name in FORMATS}
    unpack_ms["Mono12p, plain"] = unpacking("Mono12p", plain_unpack_12p)
    click.echo("unpacking 2048 x 2048: " + ", ".join(f"{name} {taken:.1f} ms" for name, taken in unpack_ms.items()))
    if json_path is not None:
        figures = {
            "stale": stale,
            "equal": equal,
            "idle_tick": idle,
            "speed": speeds,
            "chain": chains,
            "unpack_ms": unpack_ms,
        }
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.cameras"))
