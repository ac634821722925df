"""The command `lightpage train`: a recording and a calibration to a trained decoder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lightpage.calibration.document import DEFAULT_PAGES, Calibration, load_calibration
from lightpage.cli.options import JSON, FiniteRange, named_profile, profile_option
from lightpage.cli.paths import OutputFolder
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import Profile
from lightpage.errors import RecordingError
from lightpage.files import write_json
from lightpage.progress import reporting
from lightpage.recording.reader import Recording
from lightpage.train.commands.options import ACCEPT, chosen_localizer, chosen_trainer, given_choices, with_choices
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.models.decoder import LOCALIZERS
from lightpage.train.processes import AUTO, STRATEGIES, Processes, Silence, is_first_process, wait_for_first
from lightpage.train.published.localizers import NAMES as PUBLISHED
from lightpage.train.runs import Run, sole_writer
from lightpage.train.trainers.calibration import calibrate_recording
from lightpage.train.trainers.whole_run import Split, make_run, usable_pages
from lightpage.words import counted


@click.command()
@profile_option
@click.option(
    "--recording",
    "recording_path",
    required=True,
    type=click.Path(path_type=Path),
    help="HDF5 recording with known symbols.",
)
@click.option(
    "--localizer",
    type=click.Choice([*PUBLISHED, *LOCALIZERS]),
    help="coherent follows rays, wave follows waves; none, mode and ray are the published decoders, with their network "
    "and way of training. [default: the preset's]",
)
@click.option("--out", required=True, type=OutputFolder(), help="Folder of the run; resumed if it is there.")
@click.option(
    "--calibration",
    "calibration_path",
    type=click.Path(path_type=Path),
    help="Calibration of the device; made from the recording if left out.",
)
@click.option(ACCEPT, "accept_wrong_fit", is_flag=True, help="Train with a calibration whose fit is wrong too.")
@click.option(
    "--validation-share",
    type=FiniteRange(0.01, 0.5),
    default=0.08,
    show_default=True,
    help="Share of the pages that training is judged by.",
)
@click.option(
    "--test-share",
    type=FiniteRange(0, 0.5),
    default=0.08,
    show_default=True,
    help="Share of the pages that is left for `evaluate`.",
)
@with_choices
@click.option(
    "--devices",
    type=click.IntRange(min=1),
    help="GPUs of each node, or processes without one; all GPUs, or one process, by default.",
)
@click.option("--nodes", default=1, show_default=True, type=click.IntRange(min=1), help="Machines that train together.")
@click.option(
    "--strategy",
    type=click.Choice(STRATEGIES),
    default=AUTO,
    show_default=True,
    help="Lightning's strategy of several processes; auto is ddp.",
)
@JSON
def train(
    profile_name: str | None,
    recording_path: Path,
    localizer: str | None,
    out: Path,
    calibration_path: Path | None,
    accept_wrong_fit: bool,
    validation_share: float,
    test_share: float,
    devices: int | None,
    nodes: int,
    strategy: str,
    json_path: Path | None,
    **chosen: Any,
) -> None:
    """Train a decoder on known pages; the last pages of the recording stay unseen for `lightpage evaluate`."""
    processes = Processes(devices or AUTO, nodes, strategy).checked()
    keep_freed_memory()
    localizer = chosen_localizer(localizer, chosen["preset"])
    given = given_choices(localizer, chosen)
    context = click.get_current_context()
    context.meta["lightpage.resume"] = "run the same command again; it goes on where it was"
    if not is_first_process():
        context.with_resource(reporting(Silence()))
    with Recording.open(recording_path) as recording:
        profile = recording.header.device(named_profile(profile_name))
        if not recording.has_symbols:
            expected = "known symbols to train on; of user data, recover --known-out makes them"
            raise RecordingError(f"recording {recording_path}", "no dataset 'symbols'", expected)
        context.with_resource(sole_writer(out))
        usable = usable_pages(recording)
        split = Split.of(recording, list(usable), validation_share, test_share)
        trainer = chosen_trainer(localizer, profile, len(split.training), given)

        def calibration() -> Calibration:
            found = _calibration(recording, profile, list(usable)[:DEFAULT_PAGES], calibration_path, out, processes)
            if not accept_wrong_fit:
                found.check_good(f"calibration {calibration_path or 'of the recording'}", f", or {ACCEPT}")
            return found

        run = make_run(out, recording, profile, trainer, usable, split, calibration, processes)
        if run is None:
            return
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
        f"pages trained on, {counted(validated, 'validation page')}, {left} left for evaluate, kappa scaled by "
        f"{run.kappa_scale:.3f}, {run.seconds / 60:.1f} min; run in {folder}"
    )


def _calibration(
    recording: Recording, profile: Profile, pages: list[int], path: Path | None, out: Path, processes: Processes
) -> Calibration:
    """The calibration that was named, or was made of these pages for this run before, or is made of them now."""
    if path is not None:
        return load_calibration(path)
    kept, hashes = out / "calibration.toml", tuple(recording.page_hash(page) for page in pages)

    def made() -> bool:
        return kept.exists() and load_calibration(kept).calibrated_pages == hashes

    if not is_first_process():
        wait_for_first(made, True, f"calibration {kept}")
    if made():
        return load_calibration(kept)
    with percent_bar() as progress:
        calibration = calibrate_recording(recording, profile, pages, progress, compute=processes.device)
    calibration.save(kept)
    return calibration
