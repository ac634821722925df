"""The command `lightpage train`: a recording and a calibration to a trained decoder."""

from __future__ import annotations

import shlex
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from optics.errors import InvalidInputError, RecordingError
from optics.page import pilot_mask
from optics.profile import load_profile
from optics.recording import Recording
from optics.registration.calibration import Calibration, load_calibration
from train.cli_calibrate import DEFAULT_PAGES, calibrate_recording, calibration_bar
from train.features import FeatureExtractor
from train.fitting import Hyperparameters, PageDataset, best_kappa_scale, fit_network
from train.run import GOLDEN, REFERENCES, Run, save_network

PUBLISHED = ("none", "mode", "ray")
TRAINABLE = ("coherent", "wave")
_FEWEST_PAGES = 6


@click.command()
@click.option("--profile", "profile_name", required=True, help="Shipped profile or TOML file.")
@click.option("--recording", "recording_path", required=True, type=click.Path(path_type=Path), help="Known pages.")
@click.option("--localizer", type=click.Choice([*PUBLISHED, *TRAINABLE]), default="coherent", show_default=True)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder of the run; resumed if it is there."
)
@click.option("--calibration", "calibration_path", type=click.Path(path_type=Path), help="Made here if left out.")
@click.option("--steps", type=click.IntRange(min=10), default=Hyperparameters.steps, show_default=True)
@click.option("--batch", type=click.IntRange(min=1), default=Hyperparameters.batch, show_default=True)
@click.option("--channels", type=click.IntRange(min=4), default=Hyperparameters.channels, show_default=True)
@click.option("--blocks", type=click.IntRange(min=1), default=Hyperparameters.blocks, show_default=True)
@click.option("--levels", type=click.IntRange(min=0, max=4), default=Hyperparameters.levels, show_default=True)
@click.option("--learning-rate", type=float, default=Hyperparameters.learning_rate, show_default=True)
@click.option("--precision", default=Hyperparameters.precision, show_default=True, help="Lightning's precision.")
@click.option("--validation-share", type=click.FloatRange(0.01, 0.5), default=0.08, show_default=True)
@click.option("--test-share", type=click.FloatRange(0, 0.5), default=0.08, show_default=True, help="Left for evaluate.")
@click.option("--seed", type=int, default=0, show_default=True)
def train(
    profile_name: str,
    recording_path: Path,
    localizer: str,
    out: Path,
    calibration_path: Path | None,
    steps: int,
    batch: int,
    channels: int,
    blocks: int,
    levels: int,
    learning_rate: float,
    precision: str,
    validation_share: float,
    test_share: float,
    seed: int,
) -> None:
    """Train a decoder on known pages; the last pages of the recording stay unseen for `lightpage evaluate`."""
    if localizer in PUBLISHED:
        raise InvalidInputError(
            "--localizer", localizer, f"one of {', '.join(TRAINABLE)}; the published ones are not in this version"
        )
    context = click.get_current_context()
    context.meta["lightpage.resume"] = "run the same command again; it goes on from the last checkpoint"
    choices = Hyperparameters(
        channels=channels,
        blocks=blocks,
        levels=levels,
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        seed=seed,
        precision=precision,
    )
    profile = load_profile(profile_name)
    with Recording.open(recording_path) as recording:
        recording.check_against(profile)
        if not recording.has_symbols:
            raise RecordingError(f"recording {recording_path}", "no dataset 'symbols'", "known symbols to train on")
        calibration = _calibration(recording, profile_name, calibration_path, out)
        calibration.check_profile(profile)
        groups = _split(recording, calibration, validation_share, test_share)
        extractor = FeatureExtractor(
            profile, calibration.vector, calibration.turn_rad, recording.references(), localizer
        )
        light, phases = _features(recording, extractor, [*groups[0], *groups[1]], out, calibration, localizer)
        mask = recording.pilots()
        mask = pilot_mask(profile) if mask is None else mask
        count = len(groups[0])
        started = time.monotonic()
        module, air = fit_network(
            out,
            choices,
            extractor.positions,
            mask,
            PageDataset(light[:count], phases[:count]),
            PageDataset(light[count:], phases[count:]),
        )
        seconds = time.monotonic() - started
        module = module.float()
        scale = best_kappa_scale(module, PageDataset(light[count:], phases[count:]), mask)
        save_network(module, out)
        references = recording.references()
        np.savez_compressed(
            out / REFERENCES, in_phase=references.in_phase, quadrature=references.quadrature, pilots=mask
        )
        golden = recording.frames(groups[1][0])
        np.savez_compressed(out / GOLDEN, in_phase=golden.in_phase, quadrature=golden.quadrature)
        Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=calibration.to_toml(),
            hyperparameters=choices,
            camera_bit_depth=recording.bit_depth,
            frame_dtype=str(golden.in_phase.dtype),
            trained_pages=tuple(recording.page_hash(index) for group in groups[:2] for index in group),
            validation_air=air,
            kappa_scale=scale,
            seconds=seconds,
            provenance={"command": shlex.join(["lightpage", *sys.argv[1:]]), "seed": seed, "commit": _commit()},
        ).save(out)
    click.echo(
        f"validation AIR {air:.3f} bits/symbol, {len(groups[0])} training and {len(groups[1])} validation pages, "
        f"{len(groups[2])} left for evaluate, kappa scaled by {scale:.3f}; run in {out}"
    )


def _calibration(recording: Recording, profile_name: str, path: Path | None, out: Path) -> Calibration:
    """The calibration that was named, or was made before, or is made now from the first pages."""
    out.mkdir(parents=True, exist_ok=True)
    kept = out / "calibration.toml"
    if path is not None:
        return load_calibration(path)
    if kept.exists():
        return load_calibration(kept)
    with calibration_bar() as progress:
        calibration = calibrate_recording(recording, load_profile(profile_name), DEFAULT_PAGES, progress)
    calibration.save(kept)
    return calibration


def _split(
    recording: Recording, calibration: Calibration, validation_share: float, test_share: float
) -> tuple[list[int], list[int], list[int]]:
    """Pages for training, validation and, last, for nobody here; calibrated pages are trained on at most."""
    pages = recording.pages
    if pages < _FEWEST_PAGES:
        raise RecordingError(
            f"recording {recording.path}", f"{pages} pages", f"at least {_FEWEST_PAGES} to train, validate and evaluate"
        )
    test = round(pages * test_share) if test_share == 0 else max(1, round(pages * test_share))
    validation = max(1, round(pages * validation_share))
    first = pages - test - validation
    return list(range(first)), list(range(first, first + validation)), list(range(first + validation, pages))


def _features(
    recording: Recording,
    extractor: FeatureExtractor,
    indices: list[int],
    out: Path,
    calibration: Calibration,
    localizer: str,
) -> tuple[NDArray[np.float16], NDArray[np.float32]]:
    """Features of all pages, kept beside the run and taken from there when the run goes on."""
    path = out / "features.npz"
    key = f"{localizer} {recording.path.resolve()} {indices} {calibration.to_toml()}"
    if path.exists():
        with np.load(path) as kept:
            if str(kept["key"]) == key:
                return kept["light"], kept["phases"]
    light, phases = [], []
    with torch.inference_mode():
        for page in tqdm(extractor.pages(recording, indices), total=len(indices), desc="features", unit="page"):
            light.append(page.light)
            phases.append(page.phases)
    stacked = np.stack(light), np.stack(phases)
    partial = path.with_suffix(".partial.npz")
    np.savez(partial, key=np.array(key), light=stacked[0], phases=stacked[1])
    partial.replace(path)
    return stacked


def _commit() -> str:
    """The commit of the working tree, empty outside one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
