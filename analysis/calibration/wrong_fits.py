"""Calibrations that must not be called good: wrong symbols, profiles, cameras, and devices that the model lacks.

    python -m analysis.calibration.wrong_fits --json F

Each fit is refused with an error or gets a verdict; none may be good.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import click
import numpy as np

from lightpage.calibration.calibrate import KnownPage, calibrate
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.errors import CalibrationError, LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin

LEVELS = 256


@dataclass(frozen=True)
class Taken:
    """Input of a calibration: the profile, reference frames and known pages."""

    profile: Profile
    references: FramePair
    pages: list[KnownPage]


@dataclass(frozen=True)
class Called:
    """Outcome of a calibration: a verdict or an error, with its words."""

    name: str
    verdict: str
    words: str


def taken(
    profile: Profile, seed: int, *settings: str, shown: Callable[[np.ndarray], np.ndarray] | None = None
) -> Taken:
    """Two pages of a realistic device with these settings; `shown` says what of the symbols the modulator shows."""
    simulator = Simulator(profile, Device().with_settings(list(settings)), LEVELS, seed)
    symbols = random_symbols(profile, LEVELS, 2, np.random.default_rng([seed, 3]))
    pairs = [simulator.page(page if shown is None else shown(page)) for page in symbols]
    phasors = [np.exp(1j * symbol_phases(page, LEVELS)) for page in symbols]
    return Taken(profile, simulator.references(), [KnownPage(*both) for both in zip(pairs, phasors, strict=True)])


def wrong_fits(profile: Profile, seed: int) -> Iterator[tuple[str, Taken]]:
    """Name and what a calibration is given of each."""
    right, rng = taken(profile, seed), np.random.default_rng(seed)
    lens, pipe = profile.lens, profile.pipe
    longer = {
        "lens": lens.model_copy(update={"focal_length_m": 1.2 * lens.focal_length_m}),
        "pipe": pipe.model_copy(update={"length_m": 1.2 * pipe.length_m}),
    }
    for part, changed in longer.items():
        yield (
            f"profile of another device: {part} a fifth longer",
            replace(right, profile=profile.model_copy(update={part: changed})),
        )

    def with_symbols(change: Callable[[np.ndarray], np.ndarray]) -> Taken:
        return replace(right, pages=[KnownPage(page.pair, change(page.symbols)) for page in right.pages])

    yield (
        "symbols of the other page",
        replace(
            right, pages=[KnownPage(p.pair, q.symbols) for p, q in zip(right.pages, right.pages[::-1], strict=True)]
        ),
    )
    other = np.exp(2j * np.pi * rng.random(profile.page_shape))
    yield (
        "a third of the symbols wrong",
        with_symbols(lambda page: np.where(rng.random(page.shape) < 1 / 3, other, page)),
    )
    foreign = KnownPage(right.pages[1].pair, other)
    yield "symbols of the second page foreign", replace(right, pages=[right.pages[0], foreign])
    yield "symbols a column to the right", with_symbols(lambda page: np.roll(page, 1, axis=1))
    pairs = [page.pair for page in right.pages]
    mirrored = [FramePair(pair.in_phase, np.ascontiguousarray(pair.quadrature[:, ::-1])) for pair in pairs]
    mixed = [FramePair(one.in_phase, two.quadrature) for one, two in zip(pairs, pairs[::-1], strict=True)]
    for name, frames in (("one camera mirrored", mirrored), ("quadrature of the other page", mixed)):
        pages = [KnownPage(pair, page.symbols) for pair, page in zip(frames, right.pages, strict=True)]
        yield name, replace(right, pages=pages)
    jitter = rng.integers(-12, 13, LEVELS)

    def jittered(page: np.ndarray) -> np.ndarray:
        return np.asarray((page.astype(int) + jitter[page]) % LEVELS, np.uint8)

    yield "lookup table with 0.17 rad of noise", taken(profile, seed, shown=jittered)
    for name, setting in (
        ("walls 0.4% further apart in y", "geometry.pipe_height_relative_error=0.004"),
        ("a tenth of the light passes three times", "geometry.ghost_relative=0.1"),
        ("camera tilted by 0.6 rad", "in_phase_camera.tilt_x_rad=0.6"),
        ("crosstalk of modulator pixels", "slm.crosstalk_relative=0.2"),
    ):
        yield name, taken(profile, seed, setting)


def called(name: str, given: Taken) -> Called:
    """Calibrate, and return the verdict or the error."""
    twin, solve = TorchTwin(RayTwin(given.profile)), TorchFieldSolver(FieldRecovery(given.profile))
    try:
        found = calibrate(twin, solve, given.profile, given.references, given.pages).goodness
    except LightpageError as error:
        return Called(name, "refused", str(error))
    assert found is not None
    return Called(name, found.verdict, f"{found.bits_lost:.2f} bit lost; {found.cause}")


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True)
@click.option("--seed", default=1, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(profile_name: str, seed: int, json_path: Path) -> None:
    """Calibrate with what cannot be right, and tell what each calibration says."""
    outcomes = []
    for name, given in track(list(wrong_fits(load_profile(profile_name), seed)), "calibrate", unit="fit"):
        outcomes.append(called(name, given))
        click.echo(f"{name:<42} {outcomes[-1].verdict:<8} {outcomes[-1].words}")
        write_figures(json_path, {"outcomes": [asdict(each) for each in outcomes]})
    good = [each.name for each in outcomes if each.verdict == "good"]
    if good:
        raise CalibrationError("wrong fits", f"{', '.join(good)} called good", "none")
    click.echo(f"none of {len(outcomes)} is called good")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.calibration.wrong_fits"))
