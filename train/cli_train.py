"""The command `lightpage train`: a recording and a calibration to a trained decoder."""

from __future__ import annotations

import hashlib
import math
import shlex
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from torch.utils.data import ConcatDataset

from optics.errors import FrameError, InvalidInputError, RecordingError
from optics.files import OutputFile, write_json
from optics.frames import check_pair_light
from optics.page import pilot_mask, pilot_symbols, symbol_phases
from optics.profile import Profile, load_profile
from optics.progress import percent_bar
from optics.recording import Recording, hash_frames
from optics.registration.calibration import Calibration, load_calibration
from optics.registration.known import known_pages
from train.cli_calibrate import DEFAULT_PAGES, calibrate_recording
from train.feature_store import FeatureStore, fill
from train.features import FeatureExtractor
from train.fitting import Hyperparameters, Page, best_kappa_scale, fit_network
from train.localizers.coherent import SAMPLES, CoherentLocalizer
from train.network import SymbolUNet
from train.run import (
    DESCRIPTION,
    GOLDEN,
    REFERENCES,
    Run,
    begin,
    check_begun,
    is_first_process,
    load_network,
    load_run,
    save_arrays,
    save_network,
    sole_writer,
)
from train.synthetic import MOST_NOISE, SyntheticPages, likeness

PUBLISHED = ("none", "mode", "ray")
TRAINABLE = ("coherent", "wave")
DEFAULT_SYNTHETIC_PAGES = 96
_FEWEST_PAGES = 6
_LIKENESS_PAGES = 2
"""Recorded pages that the wave model is compared with: each has thousands of symbols."""


@click.command()
@click.option("--profile", "profile_name", required=True, help="Shipped profile or TOML file.")
@click.option("--recording", "recording_path", required=True, type=click.Path(path_type=Path), help="Known pages.")
@click.option("--localizer", type=click.Choice([*PUBLISHED, *TRAINABLE]), default="coherent", show_default=True)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder of the run; resumed if it is there."
)
@click.option("--calibration", "calibration_path", type=click.Path(path_type=Path), help="Made here if left out.")
@click.option(
    "--steps",
    type=click.IntRange(min=10),
    default=Hyperparameters.steps,
    show_default=True,
    help="Optimiser steps: 300 for a first try, thousands for all that a device gives.",
)
@click.option(
    "--batch", type=click.IntRange(min=1), default=Hyperparameters.batch, show_default=True, help="Pages a step."
)
@click.option(
    "--channels",
    type=click.IntRange(min=4),
    default=Hyperparameters.channels,
    show_default=True,
    help="Of the network.",
)
@click.option(
    "--blocks",
    type=click.IntRange(min=1),
    default=Hyperparameters.blocks,
    show_default=True,
    help="Residual blocks of the network, at each of its levels.",
)
@click.option(
    "--levels",
    type=click.IntRange(min=0, max=4),
    default=Hyperparameters.levels,
    show_default=True,
    help="Levels of the network below symbol pitch; 0 is the flat one.",
)
@click.option(
    "--learning-rate",
    type=float,
    default=Hyperparameters.learning_rate,
    show_default=True,
    help="Peak of the one-cycle schedule.",
)
@click.option(
    "--precision",
    type=click.Choice(["bf16-mixed", "16-mixed", "32-true"]),
    default=Hyperparameters.precision,
    show_default=True,
    help="Of the network's arithmetic; bf16-mixed is fastest where the processor has it.",
)
@click.option(
    "--validation-share",
    type=click.FloatRange(0.01, 0.5),
    default=0.08,
    show_default=True,
    help="Share of the pages that training is judged by.",
)
@click.option("--test-share", type=click.FloatRange(0, 0.5), default=0.08, show_default=True, help="Left for evaluate.")
@click.option(
    "--synthetic-pages",
    type=click.IntRange(min=0),
    default=DEFAULT_SYNTHETIC_PAGES,
    show_default=True,
    help="Pages that the fitted device would show after drifts, trained on beside the recorded ones.",
)
@click.option("--start", type=click.Path(path_type=Path), help="Finished run whose weights this one begins with.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Of initial weights, batches and rotations.",
)
@click.option(
    "--devices",
    type=click.IntRange(min=1),
    help="GPUs, or processes without one; all GPUs, or one process, by default.",
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
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
    synthetic_pages: int,
    start: Path | None,
    seed: int,
    devices: int | None,
    json_path: Path | None,
) -> None:
    """Train a decoder on known pages; the last pages of the recording stay unseen for `lightpage evaluate`."""
    if localizer in PUBLISHED:
        raise InvalidInputError(
            "--localizer", localizer, f"one of {', '.join(TRAINABLE)}; the published ones are not in this version"
        )
    if not (math.isfinite(learning_rate) and learning_rate > 0):
        raise InvalidInputError("--learning-rate", learning_rate, "a positive number")
    context = click.get_current_context()
    context.meta["lightpage.resume"] = "run the same command again; it goes on where it was"
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
        context.with_resource(sole_writer(out))
        first = None if start is None else _first_network(start, profile, localizer, choices)
        hashes = _usable(recording)
        groups = _split(recording, list(hashes), validation_share, test_share)
        references = recording.references()
        options = {
            "--profile": profile.to_toml(),
            "--recording (SHA-256 of its frames)": _digest([*hashes.values(), hash_frames(references)]),
            "--localizer": localizer,
            "--validation-share": validation_share,
            "--test-share": test_share,
            "--synthetic-pages": synthetic_pages,
            "--start": None if start is None else str(start.resolve()),
            **{f"--{name.replace('_', '-')}": value for name, value in asdict(choices).items()},
        }
        check_begun(out, options)
        calibration = _calibration(recording, profile_name, calibration_path, out)
        calibration.check_profile(profile)
        options["calibration"] = calibration.to_toml()
        extractor = FeatureExtractor(profile, calibration.vector, calibration.turn_rad, references, localizer)
        extractor.check(known_pages(recording, profile, groups[0][:1])[0], calibration.coherence_after)
        begin(out, options)
        if (out / DESCRIPTION).exists():
            _tell(load_run(out), out, json_path)
            return
        key = _digest([options[name] for name in ("--profile", "--recording (SHA-256 of its frames)", "calibration")])
        known = [*groups[0], *groups[1]]
        preparing = fill(
            out / "features",
            f"{key} {localizer}",
            len(known),
            lambda first, shift: extractor.pages(recording, known[first:], shift),
            "recorded pages",
        )
        synthetic = _synthetic(
            recording, extractor, synthetic_pages, groups[0], out, calibration, profile, localizer, seed
        )
        mask = recording.pilots()
        mask = pilot_mask(profile) if mask is None else mask
        count = len(groups[0])
        training: ConcatDataset[Page] = ConcatDataset(
            [FeatureStore(out / "features", range(count)), *map(FeatureStore, synthetic)]
        )
        validation = FeatureStore(out / "features", range(count, len(known)))
        fitted = fit_network(
            out, choices, mask, recording.levels, training, validation, start=first, devices=devices or "auto"
        )
        if not is_first_process():
            return
        scale = best_kappa_scale(fitted.module, validation, mask)
        save_network(fitted.module, out)
        own = _own_pilots(recording, profile, mask, known)
        kept = {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": mask}
        save_arrays(out / REFERENCES, kept if own is None else kept | {"pilot_phases": own})
        golden = recording.frames(groups[1][0])
        save_arrays(out / GOLDEN, {"in_phase": golden.in_phase, "quadrature": golden.quadrature})
        run = Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=calibration.to_toml(),
            hyperparameters=choices,
            camera_bit_depth=recording.bit_depth,
            trained_pages=tuple(hashes[page] for page in known),
            validation_air=fitted.validation_air,
            kappa_scale=scale,
            seconds=preparing + fitted.seconds,
            pages=(len(groups[0]), len(groups[1]), len(groups[2])),
            synthetic_pages=len(training) - count,
            provenance={"command": shlex.join(["lightpage", *sys.argv[1:]]), "seed": seed, "commit": _commit()},
        )
        run.save(out)
    _tell(run, out, json_path)


def _tell(run: Run, folder: Path, json_path: Path | None) -> None:
    """The figures of a finished run, for people and, if wanted, for machines."""
    trained, validated, left = run.pages
    if json_path is not None:
        write_json(
            json_path,
            {
                "validation_air_bits_per_symbol": run.validation_air,
                "kappa_scale": run.kappa_scale,
                "training_seconds": run.seconds,
                "pages": {"training": trained, "validation": validated, "left_for_evaluate": left},
                "synthetic_pages": run.synthetic_pages,
                "run": str(folder),
            },
        )
    click.echo(
        f"validation AIR {run.validation_air:.3f} bits/symbol, {trained} recorded and {run.synthetic_pages} synthetic "
        f"pages trained on, {validated} validation pages, {left} left for evaluate, kappa scaled by "
        f"{run.kappa_scale:.3f}, {run.seconds / 60:.1f} min; run in {folder}"
    )


def _usable(recording: Recording) -> dict[int, str]:
    """Hashes of the pages that show light, by page; the others are named and left out."""
    hashes = {}
    for page in range(recording.pages):
        pair = recording.frames(page)
        try:
            check_pair_light(f"recording {recording.path}, page {page}, ", pair, recording.bit_depth)
        except FrameError as error:
            click.echo(f"lightpage: warning: left out: {error}", err=True)
        else:
            hashes[page] = hash_frames(pair)
    return hashes


def _calibration(recording: Recording, profile_name: str, path: Path | None, out: Path) -> Calibration:
    """The calibration that was named, or was made for this run before, or is made now from the first pages."""
    kept = out / "calibration.toml"
    if path is not None:
        return load_calibration(path)
    if kept.exists():
        return load_calibration(kept)
    with percent_bar() as progress:
        calibration = calibrate_recording(recording, load_profile(profile_name), DEFAULT_PAGES, progress)
    calibration.save(kept)
    return calibration


def _first_network(start: Path, profile: Profile, localizer: str, choices: Hyperparameters) -> SymbolUNet:
    """The network of a finished run, checked to be of the size that this run wants."""
    run = load_run(start)
    size = (run.localizer, run.profile.page_shape, *_size(run.hyperparameters))
    wanted = (localizer, profile.page_shape, *_size(choices))
    if size != wanted:
        raise InvalidInputError(f"--start {start}: localizer, page, channels, blocks, levels", size, f"{wanted}")
    coherent = CoherentLocalizer(profile).light_channels
    return load_network(start, run, coherent if localizer == "coherent" else 2 * SAMPLES**2)


def _size(choices: Hyperparameters) -> tuple[int, int, int]:
    return choices.channels, choices.blocks, choices.levels


def _split(
    recording: Recording, usable: list[int], validation_share: float, test_share: float
) -> tuple[list[int], list[int], list[int]]:
    """Usable pages for training, validation and, last, for nobody here."""
    pages = len(usable)
    if pages < _FEWEST_PAGES:
        raise RecordingError(
            f"recording {recording.path}",
            f"{pages} usable pages",
            f"at least {_FEWEST_PAGES} to train, validate and evaluate",
        )
    test = round(pages * test_share) if test_share == 0 else max(1, round(pages * test_share))
    validation = max(1, round(pages * validation_share))
    first = pages - test - validation
    if first < _LIKENESS_PAGES:
        got = f"{validation} validation and {test} test pages of {pages}"
        raise InvalidInputError("--validation-share and --test-share", got, f"{_LIKENESS_PAGES} pages left to train on")
    return usable[:first], usable[first : first + validation], usable[first + validation :]


def _own_pilots(
    recording: Recording, profile: Profile, mask: NDArray[np.bool_], pages: list[int]
) -> NDArray[np.float32] | None:
    """Phases of the device's own fixed pilots, [pilots], radians; None where they are those of the profile.

    Says so where there are none: on pages whose symbols are unknown, nothing then shows the piston.
    """
    seen = np.stack([symbols[mask] for page in pages if (symbols := recording.symbols(page)) is not None])
    if np.any(seen != seen[0]):
        click.echo(
            "the symbols at the pilots differ from page to page: without symbols, such pages have no piston", err=True
        )
        return None
    if np.array_equal(seen[0], pilot_symbols(profile, recording.levels)[mask]):
        return None
    return symbol_phases(seen[0], recording.levels).astype(np.float32)


def _synthetic(
    recording: Recording,
    extractor: FeatureExtractor,
    count: int,
    training: list[int],
    out: Path,
    calibration: Calibration,
    profile: Profile,
    localizer: str,
    seed: int,
) -> list[Path]:
    """Folder with the features of synthetic pages; none where the wave model is not like the device."""
    if count == 0:
        return []
    known = known_pages(recording, profile, training[:_LIKENESS_PAGES])
    phases = [np.angle(page.symbols) for page in known]
    fields = [extractor.known_field(page.pair, written) for page, written in zip(known, phases, strict=True)]
    like = likeness(profile, calibration.vector, fields, phases)
    if like.noise > MOST_NOISE:
        click.echo(f"no synthetic pages: the wave model leaves {like.noise:.0%} of the light unexplained")
        return []
    click.echo(f"the wave model leaves {like.noise:.1%} of the recorded light unexplained")
    folder = out / "synthetic"
    pages = SyntheticPages(profile, calibration.vector, like, localizer, seed)
    key = f"{localizer} {seed} {profile.to_toml()} {calibration.to_toml()} {like.noise:.6f} "
    key += f"{np.round(like.illumination, 6).tolist()}"
    fill(folder, key, count, lambda first, shift: pages.pages(first), "synthetic pages")
    return [folder]


def _digest(parts: list[object]) -> str:
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()


def _commit() -> str:
    """The commit of this source tree, empty where it is not one."""
    tree = Path(__file__).parent.parent
    command = ["git", "-C", str(tree), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # no git
        return ""
    toplevel, _, commit = done.stdout.strip().partition("\n")
    return commit if done.returncode == 0 and Path(toplevel) == tree.resolve() else ""
