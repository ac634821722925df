"""Compare a decoder of one pass with an oracle, on imperfect devices that the oracle knows.

    python -m analysis.comparison.imperfections --out runs/imperfections
    python -m analysis.comparison.imperfections --device axial --out runs/imperfections
    python -m analysis.comparison.imperfections --set slm.stroke_relative_error=-0.03 --out runs/stroke
    python -m analysis.comparison.imperfections --drawn 1000 --drawn 1001 --out runs/drawn

Every device is recorded and calibrated from nominal. Decoder and oracle are the methods wave and oracle of
`analysis.comparison.decoders`, with the network of the preset `standard`, the same steps and pages. Interrupted, it
goes on where it was; all lies in --out. `--drawn` takes a device of the whole capture range, the one that
`analysis.calibration.devices` draws by this seed.

The oracle's equations are linear: where cameras stand some 1.5 rad apart, they miss one of two numbers on a ring of the
facet (`train/models/apart.py`), and it reads less than the decoder.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import click
import numpy as np

from analysis.comparison.data_set import CALIBRATED, recorded
from analysis.comparison.methods.bench import ORACLE, Bench
from analysis.comparison.methods.symbols import symbol_method
from analysis.comparison.weight_store import TRAINED, WeightStore
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFolder
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, draw_device
from lightpage.metrics.provenance import write_figures
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.models.decoder import WAVE
from lightpage.train.models.presets import PRESETS, REFLECTIONS, STANDARD
from lightpage.train.runs import sole_writer


def _axial(modulator: float, in_phase: float, quadrature: float) -> list[str]:
    return [
        f"geometry.modulator_axial_rad={modulator}",
        f"in_phase_camera.axial_rad={in_phase}",
        f"quadrature_camera.axial_rad={quadrature}",
    ]


def _keystone(x: float, y: float) -> list[str]:
    return [
        f"{camera}_camera.keystone_{axis}_relative={sign * value}"
        for camera, sign in (("in_phase", 1), ("quadrature", -1))
        for axis, value in (("x", x), ("y", y))
    ]


def _levels(stroke: float, sine: float) -> list[str]:
    return [f"slm.stroke_relative_error={stroke}", f"slm.level_sine_rad={sine}"]


OWN = "set"
DEVICES = {
    "usual": [],
    "levels": _levels(-0.015, 0.15),
    "unmodulated": ["slm.unmodulated_relative=0.1"],
    "axial": _axial(1.2, 0.8, -0.7),
    "axial-half": _axial(0.6, 0.4, -0.3),
    "keystone": _keystone(0.0015, 0.001),
    "third": [
        *_levels(-0.005, 0.05),
        "slm.unmodulated_relative=0.033",
        *_axial(0.4, 0.27, -0.23),
        *_keystone(0.0005, 0.00033),
    ],
}
"""Changes of the default device; the last has a third of all the others."""
_HELD_OUT_SHARE = 0.2
_VALIDATED = 2


@dataclass(frozen=True)
class Row:
    """Figures of one device: AIRs of held-out pages, bits a symbol; seconds of the decoder's features and training."""

    device: str
    settings: list[str]
    air: float
    oracle_air: float
    ratio: float
    angle_error_deg: float
    seconds: float

    def line(self) -> str:
        return (
            f"{self.device:<12} {self.air:>7.3f} {self.oracle_air:>7.3f} {self.ratio:>7.3f} "
            f"{self.angle_error_deg:>+10.4f} {self.seconds:>8.0f}"
        )


HEADER = f"{'device':<12} {'AIR':>7} {'oracle':>7} {'ratio':>7} {'angle off':>10} {'seconds':>8}"


def measured(
    name: str, device: Device, settings: list[str], profile: Profile, pages: int, steps: int, seed: int, out: Path
) -> Row:
    """Record and calibrate a device, or go on with it, and train the decoder and the oracle."""
    device = device.of_profile(profile).with_settings(settings)
    folder = out / name
    with recorded(profile, device, pages - CALIBRATED, seed, folder) as recording:
        kept = WeightStore(folder, TRAINED / profile.name / name)
        held = max(_VALIDATED, round(_HELD_OUT_SHARE * pages))
        last = pages - held
        bench = replace(
            Bench.of(recording, profile, device, (), seed, kept),
            training=range(last - _VALIDATED),
            validation=range(last - _VALIDATED, last),
            unseen=range(last, pages),
            reflections=REFLECTIONS,
        )
        choices = replace(PRESETS[STANDARD].choices, steps=steps)
        size = f"{choices.channels}x{choices.blocks}x{choices.depth}"
        decoder = symbol_method(bench, WAVE, size, choices)
        oracle = symbol_method(bench, ORACLE, size, replace(choices, reflections=0))  # its equations are linear
        off_deg = bench.fitted.angle_deg(profile) - device.geometry.pipe_angle_deg
    seconds = decoder.preparing_seconds + decoder.training_seconds
    return Row(name, settings, decoder.air, oracle.air, decoder.air / oracle.air, off_deg, seconds)


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option(
    "--device", "names", type=click.Choice(list(DEVICES)), multiple=True, help="All of them if neither is given."
)
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="A device of your own.")
@click.option("--drawn", "seeds", type=click.IntRange(0), multiple=True, help="A device drawn by this seed.")
@click.option("--pages", type=click.IntRange(6), default=28, show_default=True, help="A fifth of them held out.")
@click.option("--steps", type=click.IntRange(10), default=600, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=7, show_default=True)
@click.option("--out", type=OutputFolder(), required=True, help="Folder for all of it, imperfections.json too.")
def main(
    profile_name: str,
    names: tuple[str, ...],
    settings: tuple[str, ...],
    seeds: tuple[int, ...],
    pages: int,
    steps: int,
    seed: int,
    out: Path,
) -> None:
    """Train a decoder and an oracle on each device, and print what they read of held-out pages."""
    keep_freed_memory()
    profile = load_profile(profile_name)
    click.get_current_context().with_resource(sole_writer(out))
    chosen = {name: DEVICES[name] for name in names} | ({OWN: list(settings)} if settings else {})
    devices = {name: (Device(), changes) for name, changes in (chosen or ({} if seeds else DEVICES)).items()}
    for number in seeds:
        devices[f"drawn-{number}"] = draw_device(np.random.default_rng(number)), list[str]()
    rows: list[Row] = []
    for name, (device, changes) in devices.items():
        rows.append(measured(name, device, changes, profile, pages, steps, seed, out))
        click.echo(f"{HEADER}\n{rows[-1].line()}", err=True)
        write_figures(out / "imperfections.json", {"rows": [asdict(row) for row in rows]})
    click.echo("\n".join([HEADER, *(row.line() for row in rows)]))


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.comparison.imperfections"))
