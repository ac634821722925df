"""Decoders against the oracle on the same light: same pages, same network, same steps and seeds.

    python -m benchmarks.decoders --angle -0.6 --full-well 4000 --pages 200 --steps 4000 --out runs/decoders

The oracle knows the simulated truth: geometry, cameras, reference; the signal's own power is taken off its frames; then
the wave adjoint and the same network. Interrupted, it goes on where it was: features and checkpoints lie in --out.
"""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from optics.cameras import resample
from optics.device import Device, Sensor
from optics.files import replace_text
from optics.page import pilot_mask, random_symbols, symbol_phases
from optics.profile import load_profile
from optics.recording import FramePair
from optics.registration.calibrate import KnownPage, calibrate
from optics.simulator import SimulatedPage, Simulator, TrueOptics, true_parameters
from train.features import FeatureExtractor
from train.field import FieldRecovery, TorchFieldSolver
from train.fitting import Hyperparameters, PageDataset, fit_network, held_out_air
from train.twin import RayTwin, TorchTwin

LEVELS = 256
ARMS = ("coherent", "wave", "oracle")
CALIBRATED = 2
VALIDATION, HELD_OUT = 8, 12


def without_signal_power(page: SimulatedPage, optics: TrueOptics) -> FramePair:
    """The frames of a page with the counts that |E|^2 adds taken off, noise and quantisation left in, float32."""
    device = optics.device
    power = np.abs(optics.camera_field(page.exit_field)) ** 2
    counts = optics.electrons_per_unit * (2**device.sensor.bit_depth - 1) / device.sensor.full_well_e
    frames = []
    for frame, pose, gain in (
        (page.pair.in_phase, device.in_phase_camera, 1.0),
        (page.pair.quadrature, device.quadrature_camera, device.homodyne.quadrature_gain),
    ):
        seen = resample(power, *optics.camera_axes_m, *optics.view(pose, page.shift_px))
        frames.append((frame - gain * counts * seen).astype(np.float32))
    return FramePair(*frames)


def make_features(folder: Path, device: Device, pages: int, seed: int, angle_error: dict[str, float]) -> None:
    """Simulate, calibrate, and keep every arm's features of all pages behind the calibrated ones."""
    profile = load_profile("bench")
    simulator = Simulator(profile, device, LEVELS, seed)
    references = simulator.references()
    symbols = random_symbols(profile, LEVELS, pages + CALIBRATED, np.random.default_rng([seed, 7]))
    known = [KnownPage(simulator.page(page), np.exp(1j * symbol_phases(page, LEVELS))) for page in symbols[:CALIBRATED]]
    twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
    fitted = calibrate(twin, solver, profile, references, known)
    truth = true_parameters(profile, device)
    angle_error["angle_error_deg"] = float(np.rad2deg(fitted.parameters[0] - truth[0]))
    homodyne = device.homodyne
    true_turn = homodyne.quadrature_sign * np.pi / 2 + np.deg2rad(homodyne.quadrature_error_deg)
    extractors = {
        "coherent": FeatureExtractor(profile, fitted.parameters, fitted.turn, references, "coherent"),
        "wave": FeatureExtractor(profile, fitted.parameters, fitted.turn, references, "wave"),
        "oracle": FeatureExtractor(profile, truth, true_turn, references, "wave", with_signal_power=False),
    }
    shifts = {arm: np.zeros(2) for arm in ARMS}
    light: dict[str, list[NDArray[np.float16]]] = {arm: [] for arm in ARMS}
    phases = []
    for page in tqdm(symbols[CALIBRATED:], desc="pages", unit="page"):
        seen = simulator.simulate(page)
        true_phases = symbol_phases(page, LEVELS)
        for arm, extractor in extractors.items():
            pair = without_signal_power(seen, simulator.optics) if arm == "oracle" else seen.pair
            features, shifts[arm] = extractor.page(extractor.field(pair), true_phases, shifts[arm])
            light[arm].append(features.light)
        phases.append(true_phases.astype(np.float32))
    for arm in ARMS:
        np.save(folder / f"{arm}.npy", np.stack(light[arm]))
    np.save(folder / "positions.npy", extractors["coherent"].positions)
    np.save(folder / "phases.npy", np.stack(phases))


@click.command()
@click.option("--angle", "angle_deg", type=float, default=-0.6, show_default=True, help="Pipe angle, degrees.")
@click.option("--full-well", type=float, default=4000.0, show_default=True, help="Electrons; sets the noise.")
@click.option("--pages", type=click.IntRange(30), default=200, show_default=True)
@click.option("--steps", type=click.IntRange(10), default=Hyperparameters.steps, show_default=True)
@click.option("--seed", type=int, default=5000, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for features, runs, figures.json.")
def main(angle_deg: float, full_well: float, pages: int, steps: int, seed: int, out: Path) -> None:
    """Train every arm on the same pages and print held-out AIR."""
    out.mkdir(parents=True, exist_ok=True)
    device = Device(sensor=Sensor(full_well_e=full_well)).with_settings([f"geometry.pipe_angle_deg={angle_deg}"])
    figures: dict[str, object] = {"angle_deg": angle_deg, "full_well_e": full_well, "pages": pages, "steps": steps}
    error: dict[str, float] = {}
    if not (out / "phases.npy").exists():
        make_features(out, device, pages, seed, error)
        replace_text(out / "calibration.json", json.dumps(error), "JSON file")
    figures |= json.loads((out / "calibration.json").read_text())
    phases, positions = np.load(out / "phases.npy"), np.load(out / "positions.npy")
    mask = pilot_mask(load_profile("bench"))
    first = len(phases) - VALIDATION - HELD_OUT
    for arm in ARMS:
        light = np.load(out / f"{arm}.npy", mmap_mode="r")
        module, validation = fit_network(
            out / arm,
            Hyperparameters(steps=steps, seed=seed),
            positions,
            mask,
            PageDataset(light[:first], phases[:first]),
            PageDataset(light[first : first + VALIDATION], phases[first : first + VALIDATION]),
        )
        module = module.float()
        held = PageDataset(light[-HELD_OUT:], phases[-HELD_OUT:])
        with torch.no_grad():
            p = np.stack([module(held[i][0].float()[None])[0].numpy() for i in range(len(held))])
        figures[f"{arm}_air"] = held_out_air(p, phases[-HELD_OUT:], mask)
        figures[f"{arm}_validation_air"] = validation
        click.echo(f"{arm:<10} held-out AIR {figures[f'{arm}_air']:.3f} bits/symbol")
    for arm in ARMS[:-1]:
        figures[f"{arm}_over_oracle"] = float(str(figures[f"{arm}_air"])) / float(str(figures["oracle_air"]))
        click.echo(f"{arm:<10} over the oracle {figures[f'{arm}_over_oracle']:.3f}")
    replace_text(out / "figures.json", json.dumps(figures, indent=2) + "\n", "JSON file")


if __name__ == "__main__":
    main()
