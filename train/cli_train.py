"""The command `lightpage train`: a recording and a calibration to a trained decoder."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

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
from train.decoder import LOCALIZERS, WAVE
from train.features import FeatureExtractor
from train.fitting import Hyperparameters
from train.localizers.coherent import BICUBIC, BILINEAR
from train.material import Material
from train.provenance import provenance
from train.published.decoder import LENS_CHOICES
from train.published.localizers import NAMES as PUBLISHED
from train.published.recipe import PublishedRecipe, published_choices
from train.published.training import PublishedChoices
from train.run import (
    DESCRIPTION,
    GOLDEN,
    REFERENCES,
    Run,
    begin,
    check_begun,
    is_first_process,
    load_run,
    save_arrays,
    save_weights,
    sole_writer,
)
from train.symbols import LIKENESS_PAGES, USUAL_REFINEMENTS, SymbolRecipe, default_synthetic_pages

_FEWEST_PAGES = 6


def _default(name: str) -> str:
    """How the help text of an option tells its default."""
    value = getattr(Hyperparameters, name)
    return f"[default: {value if isinstance(value, str) else format(value, 'g')}]"


@click.command()
@click.option("--profile", "profile_name", required=True, help="Shipped profile or TOML file.")
@click.option("--recording", "recording_path", required=True, type=click.Path(path_type=Path), help="Known pages.")
@click.option(
    "--localizer",
    type=click.Choice([*PUBLISHED, *LOCALIZERS]),
    default="coherent",
    show_default=True,
    help="none, mode and ray are the published decoders: their network and way of training.",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder of the run; resumed if it is there."
)
@click.option("--calibration", "calibration_path", type=click.Path(path_type=Path), help="Made here if left out.")
@click.option(
    "--steps",
    type=click.IntRange(min=10),
    help="Optimiser steps: 300 for a first try, thousands for all that a device gives. "
    f"{_default('steps')}; published: 50 passes over the pages, fewer for symbols larger than 4x4.",
)
@click.option(
    "--batch",
    type=click.IntRange(min=1),
    help=f"Pages, or patches of large ones, a step. {_default('batch')}; published: 2.",
)
@click.option(
    "--binning",
    type=click.IntRange(min=1, max=2),
    help="Camera pixels along each axis whose mean is sampled, instead of filtering frames first: 2 is quicker and "
    f"less exact. {_default('binning')}; published: none to choose.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=0, max=16),
    help="Samples per symbol and axis that the coherent localizer reads; 0 takes as many as the field has. "
    f"{_default('samples')}; published: none to choose.",
)
@click.option(
    "--interpolation",
    type=click.Choice([BICUBIC, BILINEAR]),
    help=f"How it reads them off its grid: bilinear is quicker and less exact. {_default('interpolation')}; "
    "published: none to choose.",
)
@click.option(
    "--patch",
    type=click.IntRange(min=16),
    help="Larger pages are trained on in patches with so many symbols along an edge. "
    f"{_default('patch')}; published: whole pages.",
)
@click.option(
    "--channels",
    type=click.IntRange(min=4),
    help=f"Of the network. {_default('channels')}; published: 32, and twice as many below sample pitch.",
)
@click.option(
    "--blocks",
    type=click.IntRange(min=1),
    help=f"Residual blocks of the network, at each of its levels. {_default('blocks')}; published: none to choose.",
)
@click.option(
    "--levels",
    type=click.IntRange(min=0, max=4),
    help="Levels of the network below symbol pitch; 0 is the flat one. "
    f"{_default('levels')}; published: none to choose.",
)
@click.option(
    "--refinements",
    type=click.IntRange(min=0, max=4),
    help="How often the decoder looks again, for what the symbols decoded so far do not explain. "
    f"[default: {USUAL_REFINEMENTS}]; published: none to choose.",
)
@click.option(
    "--field-rounds",
    type=click.IntRange(min=0, max=20),
    help="Of descent to the field: fewer are faster, and lose most where the light is bright. "
    f"{_default('field_rounds')}; published: none to choose.",
)
@click.option(
    "--learning-rate",
    type=float,
    help=f"Peak of the one-cycle schedule, or that of the published network. {_default('learning_rate')}; published: "
    f"{PublishedChoices.decoder_rate:g}.",
)
@click.option(
    "--lenses",
    type=click.Choice(LENS_CHOICES),
    help=f"Lenses that the published rays are traced through. [default: {PublishedChoices.lenses}]",
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
    help="Pages that the fitted device would show after drifts, trained on beside the recorded ones. "
    f"[default: {default_synthetic_pages(load_profile('bench'))}, of larger ones fewer; published: none]",
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
    steps: int | None,
    batch: int | None,
    channels: int | None,
    blocks: int | None,
    levels: int | None,
    refinements: int | None,
    field_rounds: int | None,
    patch: int | None,
    binning: int | None,
    samples: int | None,
    interpolation: str | None,
    learning_rate: float | None,
    lenses: str | None,
    precision: str,
    validation_share: float,
    test_share: float,
    synthetic_pages: int | None,
    start: Path | None,
    seed: int,
    devices: int | None,
    json_path: Path | None,
) -> None:
    """Train a decoder on known pages; the last pages of the recording stay unseen for `lightpage evaluate`."""
    if learning_rate is not None and not (math.isfinite(learning_rate) and learning_rate > 0):
        raise InvalidInputError("--learning-rate", learning_rate, "a positive number")
    context = click.get_current_context()
    context.meta["lightpage.resume"] = "run the same command again; it goes on where it was"
    profile = load_profile(profile_name)
    with Recording.open(recording_path) as recording:
        recording.check_against(profile)
        if not recording.has_symbols:
            raise RecordingError(f"recording {recording_path}", "no dataset 'symbols'", "known symbols to train on")
        context.with_resource(sole_writer(out))
        hashes = _usable(recording)
        groups = _split(recording, list(hashes), validation_share, test_share)
        chosen = {"steps": steps, "batch": batch, "seed": seed, "precision": precision}
        recipe: SymbolRecipe | PublishedRecipe
        if localizer in PUBLISHED:
            recipe = _published(
                localizer,
                published_choices(profile, len(groups[0]), batch),
                {**chosen, "channels": channels, "decoder_rate": learning_rate, "lenses": lenses},
                {
                    "--blocks": blocks,
                    "--levels": levels,
                    "--refinements": refinements,
                    "--field-rounds": field_rounds,
                    "--patch": patch,
                    "--binning": binning,
                    "--samples": samples,
                    "--interpolation": interpolation,
                    "--synthetic-pages": synthetic_pages,
                    "--start": start,
                },
            )
        else:
            sizes = {"channels": channels, "blocks": blocks, "levels": levels, "refinements": refinements}
            light = {
                "field_rounds": field_rounds,
                "binning": binning,
                "samples": samples,
                "interpolation": interpolation,
            }
            wanted = {**chosen, **sizes, **light, "patch": patch, "learning_rate": learning_rate}
            refused: dict[str, object] = {"--lenses": lenses}
            if localizer == WAVE:
                refused |= {"--samples": samples, "--interpolation": interpolation}
            recipe = _symbols(profile, localizer, wanted, synthetic_pages, start, refused)
            recipe.check_start(profile)
        references = recording.references()
        options = {
            "--profile": profile.to_toml(),
            "--recording (SHA-256 of its frames)": _digest([*hashes.values(), hash_frames(references)]),
            "--validation-share": validation_share,
            "--test-share": test_share,
            **recipe.options(),
        }
        check_begun(out, options)
        calibration = _calibration(recording, profile_name, calibration_path, out)
        calibration.check_profile(profile)
        options["calibration"] = calibration.to_toml()
        features = localizer if localizer in LOCALIZERS else LOCALIZERS[0]
        choices = recipe.choices if isinstance(recipe, SymbolRecipe) else Hyperparameters()
        extractor = FeatureExtractor(
            profile,
            calibration.vector,
            calibration.turn_rad,
            references,
            features,
            rounds=choices.field_rounds,
            binning=choices.binning,
            coherent=choices.coherent_localizer(profile),
        )
        extractor.check(known_pages(recording, profile, groups[0][:1])[0], calibration.coherence_after)
        begin(out, options)
        if (out / DESCRIPTION).exists():
            _tell(load_run(out), out, json_path)
            return
        mask = recording.pilots()
        mask = pilot_mask(profile) if mask is None else mask
        trained = recipe.train(
            Material(
                out=out,
                recording=recording,
                profile=profile,
                calibration=calibration,
                extractor=extractor,
                references=references,
                training=groups[0],
                validation=groups[1],
                pilot_mask=mask,
                key=_digest([options[n] for n in ("--profile", "--recording (SHA-256 of its frames)", "calibration")]),
                devices=devices or "auto",
            )
        )
        if not is_first_process():
            return
        known = [*groups[0], *groups[1]]
        save_weights(trained.weights, out)
        own = _own_pilots(recording, profile, mask, known)
        kept = {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": mask}
        save_arrays(out / REFERENCES, kept if own is None else kept | {"pilot_phases": own})
        golden = recording.frames(groups[1][0])
        save_arrays(out / GOLDEN, {"in_phase": golden.in_phase, "quadrature": golden.quadrature})
        run = Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=calibration.to_toml(),
            hyperparameters=recipe.choices,
            camera_bit_depth=recording.bit_depth,
            trained_pages=tuple(hashes[page] for page in known),
            validation_air=trained.validation_air,
            kappa_scale=trained.kappa_scale,
            seconds=trained.seconds,
            pages=(len(groups[0]), len(groups[1]), len(groups[2])),
            synthetic_pages=trained.synthetic_pages,
            provenance=provenance("lightpage", seed),
        )
        run.save(out)
    _tell(run, out, json_path)


def _symbols(
    profile: Profile,
    localizer: str,
    chosen: dict[str, Any],
    synthetic_pages: int | None,
    start: Path | None,
    refused: dict[str, object],
) -> SymbolRecipe:
    """The way of training at symbol pitch; what was not chosen stays as it is by default."""
    _check_absent(localizer, refused)
    choices = replace(Hyperparameters(refinements=USUAL_REFINEMENTS), **_given(chosen))
    count = default_synthetic_pages(profile) if synthetic_pages is None else synthetic_pages
    return SymbolRecipe(localizer, choices, count, start)


def _published(
    localizer: str, defaults: PublishedChoices, chosen: dict[str, Any], refused: dict[str, object]
) -> PublishedRecipe:
    """The published way of training; what was not chosen stays as its authors had it."""
    _check_absent(localizer, refused)
    given = _given(chosen)
    if "channels" in given:
        given["channels"] = (given["channels"], 2 * given["channels"])
    return PublishedRecipe(localizer, replace(defaults, **given))


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _check_absent(localizer: str, options: dict[str, object]) -> None:
    for name in _given(options):
        raise InvalidInputError(name, options[name], f"no such option with --localizer {localizer}")


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
    if first < LIKENESS_PAGES:
        got = f"{validation} validation and {test} test pages of {pages}"
        raise InvalidInputError("--validation-share and --test-share", got, f"{LIKENESS_PAGES} pages left to train on")
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


def _digest(parts: list[object]) -> str:
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()
