"""Causes that a calibration names, beside the fault that a device has and what it costs.

    python -m analysis.verdicts.causes --json F
    python -m analysis.verdicts.causes --fault ghost --fault walls --json F

A device with one fault of each size is calibrated by two known pages, by the graphs of the shipped bundle where these
allow for it. Four further pages are read. What
the fault costs is the AIR that they lose against those of the same device without it. Only faults that cost at least
0.03 bit count: others are no causes of a loss. An interrupted run continues.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from analysis.comparison.data_set import CALIBRATED, simulate
from lightpage.calibration.known_pages import first_lit_pages
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.export.commands.calibrate import judged_by_reading
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track, warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.new_bundle import calibrating_decoder
from lightpage.runtime.archives.recordings.reading import MOST_READ
from lightpage.runtime.recalibration.from_nominal import OtherGraphsWantedError, calibrate_by_graphs
from lightpage.train.trainers.calibration import calibrate_recording

_SEED = 5
_LEAST_COST = 0.03
"""Least loss of a fault that counts, bits a symbol: the AIR of four pages has an error of 0.012."""


@dataclass(frozen=True)
class Fault:
    """Fault of a device.

    Attributes:
        names: names of the causes that describe it, see `lightpage.calibration.goodness.remedies`.
        sizes: its sizes.
        settings: settings of the device by `TABLE.KEY`, each as a factor on the size.
    """

    names: tuple[str, ...]
    sizes: tuple[float, ...]
    settings: dict[str, float]

    def of(self, device: Device, size: float) -> Device:
        """Return a device with the fault at a size."""
        return device.with_settings([f"{key}={factor * size:.9g}" for key, factor in self.settings.items()])


def _one(name: str, key: str, *sizes: float) -> Fault:
    return Fault((name,), sizes, {key: 1.0})


_AXIAL = {"geometry.modulator_axial_rad": 1.2, "in_phase_camera.axial_rad": 0.8, "quadrature_camera.axial_rad": -0.7}
FAULTS = {
    "hot pixels": _one("camera pixels", "sensor.hot_pixel_share", 0.01, 0.03, 0.045),
    "dust": Fault(("dust",), (2, 5, 10), {"sensor.late_dust_specks": 1}),
    "walls": _one("walls", "geometry.pipe_height_relative_error", 0.0003, 0.0006, 0.001),
    "taper": _one("taper", "geometry.pipe_taper_relative", 0.002, 0.004, 0.008),
    "ghost": _one("ghost", "geometry.ghost_relative", 0.015, 0.025, 0.045),
    "planes": Fault(("camera focus", "modulator focus"), (1, 1.5, 2), _AXIAL),
    "camera tilt": Fault(
        ("camera tilt",), (1, 2, 3), {"in_phase_camera.tilt_x_rad": 1, "quadrature_camera.tilt_y_rad": -1}
    ),
    "modulator tilt": _one("modulator tilt", "geometry.modulator_tilt_x_rad", 0.5, 1, 2),
    "levels": _one("levels", "slm.level_ripple_rad", 0.01, 0.02, 0.04),
    "crosstalk": _one("crosstalk", "slm.crosstalk_relative", 0.05, 0.1, 0.2),
    "flicker": _one("flicker", "slm.flicker_rad", 0.05, 0.1, 0.2),
    "dead pixels": _one("dead modulator pixels", "slm.dead_pixel_share", 0.0005, 0.0015, 0.004),
    "nonlinear": _one("bend", "sensor.nonlinearity_relative", -0.1, -0.2, -0.3),
    "black level": _one("black level", "sensor.black_level_relative", 0.03, 0.08, 0.15),
    "reference exposure": _one("reference exposure", "reference.recorded_exposure_relative", 1.1, 1.2, 1.4),
    "vibration": _one("vibration", "drift.vibration_rad", 0.3, 0.5, 0.8),
}


@dataclass(frozen=True)
class Row:
    """Figures of one fault at one size; AIR and causes are None where calibration ended with an error.

    Attributes:
        fault: name of the fault; empty for the device without any.
        size: its size.
        air_bits: AIR of four pages, bits a symbol.
        light_bits: information of the light as the calibration states it.
        verdict: verdict on the calibration.
        causes: bits of each cause, by its name, the largest first.
        failure: error that ended the calibration.
    """

    fault: str
    size: float
    air_bits: float | None = None
    light_bits: float | None = None
    verdict: str | None = None
    causes: dict[str, float] | None = None
    failure: str | None = None

    @property
    def named(self) -> bool:
        """Return whether the first cause is the fault."""
        return next(iter(self.causes or {}), None) in FAULTS[self.fault].names


def measured(profile: Profile, device: Device, fault: str, size: float) -> Row:
    """Calibrate and read a device."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.h5"
        simulate(path, profile, device, CALIBRATED + MOST_READ, _SEED)
        with Recording.open(path) as recording:
            decoder = calibrating_decoder(None, recording, profile)
            try:
                pages = first_lit_pages(recording, CALIBRATED, warn)
                try:
                    assert decoder is not None  # the shipped bundle is of this profile
                    calibration = calibrate_by_graphs(decoder, recording, pages, lambda stage, share: None)
                except OtherGraphsWantedError:
                    decoder = None
                    calibration = calibrate_recording(recording, profile, pages, lambda stage, share: None)
                out = Path(folder) / "bundle.zip"
                calibration = judged_by_reading(
                    decoder, calibration, recording, profile, out, lambda stage, share: None
                )
            except LightpageError as error:
                return Row(fault, size, failure=str(error))
    goodness, reading = calibration.goodness, calibration.reading
    assert goodness is not None
    return Row(
        fault,
        size,
        None if reading is None else reading.air_bits,
        None if reading is None else reading.light_bits,
        goodness.verdict,
        {cause.name: cause.bits for cause in goodness.causes},
    )


def _kept(path: Path, settings: dict[str, object]) -> dict[tuple[str, float], Row]:
    """Rows of an earlier run with the same settings.

    Raises:
        InvalidInputError: the file is something else, or of other settings.
    """
    if not path.exists():
        return {}
    try:
        document = json.loads(path.read_text("utf-8"))
        rows = [Row(**row) for row in document["rows"]]
        found = document["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"--json {path}", error, "a file of this command, or a new name") from None
    if found != settings:
        raise InvalidInputError(f"--json {path}", f"figures of {found}", f"those of {settings}, or a new name")
    return {(row.fault, row.size): row for row in rows if row.failure is None}


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--fault", "chosen", multiple=True, type=click.Choice([*FAULTS]), help="Fault; all if left out.")
@click.option("--set", "changes", multiple=True, metavar="TABLE.KEY=VALUE", help="Number of the true state to change.")
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(profile_name: str, chosen: tuple[str, ...], changes: tuple[str, ...], json_path: Path) -> None:
    """Print what each fault costs, and the causes that the calibration names."""
    profile = load_profile(profile_name)
    device = Device().of_profile(profile).with_settings([*changes])
    settings: dict[str, object] = {"profile": profile.to_toml(), "set": [*changes], "seed": _SEED}
    rows = _kept(json_path, settings)
    wanted = [("", 0.0), *((fault, size) for fault in chosen or FAULTS for size in FAULTS[fault].sizes)]
    named = counted = 0
    for fault, size in track(wanted, "faults", unit="device"):
        if (fault, size) not in rows:
            faulty = FAULTS[fault].of(device, size) if fault else device
            rows[fault, size] = measured(profile, faulty, fault, size)
            write_figures(json_path, {"settings": settings, "rows": [asdict(row) for row in rows.values()]})
        row = rows[fault, size]
        causes = ", ".join(f"{name} {bits:.3f}" for name, bits in (row.causes or {}).items())
        if row.air_bits is None or not fault:
            click.echo(
                f"{fault or 'none':<20} {size:<8g} {row.failure or f'AIR {row.air_bits}, {row.verdict}'}  {causes}"
            )
            continue
        cost = (rows["", 0.0].air_bits or 0.0) - row.air_bits
        counted += cost >= _LEAST_COST
        named += cost >= _LEAST_COST and row.named
        mark = "" if cost < _LEAST_COST else "named" if row.named else "MISSED"
        click.echo(f"{fault:<20} {size:<8g} costs {cost:+.3f}  {row.verdict:<10} {mark:<6} {causes}")
    click.echo(f"{named} of {counted} faults that cost at least {_LEAST_COST} bit are named first")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.verdicts.causes"))
