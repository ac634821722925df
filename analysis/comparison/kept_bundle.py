"""A kept method of the comparison as a bundle, so that the runtime can be measured with what was trained.

    python -m analysis.comparison.kept_bundle --kept analysis/weights/bench/-0.6deg-32e-4px --out bundle.zip

A few pages of the data set are simulated anew: they say how strong the light is, and how well calibrated the
concentrations are.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
import numpy as np

from analysis.comparison.data_set import CALIBRATED
from analysis.comparison.kept_weights import read_weights
from analysis.comparison.weight_store import CALIBRATION, KEPT_WEIGHTS
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.sampling_table import sampling_table
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import NewPath, OutputFolder
from lightpage.device.profile import Profile, parse_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.export.command import export_run
from lightpage.export.graph import DecoderGraph, table_tensors
from lightpage.export.parity import torch_answer
from lightpage.page.symbols import pilot_mask, symbol_phases
from lightpage.recording.reader import Recording, hash_frames
from lightpage.simulator.recording_job import RecordingJob
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.data.known_light import explained
from lightpage.train.fitting.concentration_scale import calibrating_factor
from lightpage.train.fitting.fitted import FITTED
from lightpage.train.fitting.validation import without_piston
from lightpage.train.models.decoder import COHERENT, SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.presets import FAST
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.runs import BEGUN, GOLDEN, REFERENCES, Run, renamed, save_arrays, save_weights
from lightpage.train.trainers.refinement import fit_prediction
from lightpage.train.trainers.symbols import MATCHED_PAGES

LEVELS = 256
JUDGED = 3
"""Pages by which concentrations are calibrated: thousands of symbols each."""


def data_set_of(kept: Path) -> tuple[Profile, Device, int]:
    """Profile, true device and seed of a kept data set.

    Raises:
        InvalidInputError: nothing is kept there.
    """
    try:
        begun = json.loads((kept / BEGUN).read_text())
        profile = parse_profile(begun["--profile"], f"{kept / BEGUN}: profile")
        return profile, Device.model_validate(begun["device"]), int(begun["--seed"])
    except KeyError as error:
        expected = "that of a data set, as analysis/weights has them"
        raise InvalidInputError(f"{kept / BEGUN}", f"no key {error}", expected) from None
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"--kept {kept}", error, f"the folder of a kept data set with its {BEGUN}") from None


def export_kept(kept: Path, work: Path, out: Path, method: str = COHERENT, refinements: int = 1) -> None:
    """Write the bundle of a method.

    Args:
        kept: folder of the data set.
        work: folder for pages and run; made, and gone on with if it is there.
        out: new bundle.
        method: fast, or the localizer of a method.
        refinements: passes behind the first, 0 or 1.

    Raises:
        InvalidInputError: no such method is kept.
    """
    profile, device, seed = data_set_of(kept)
    trained = next((folder for folder in sorted((kept / method).glob("*")) if (folder / FITTED).exists()), None)
    if trained is None:
        raise InvalidInputError(f"--kept {kept}", f"no trained {method}", "a method that is kept there")
    localizer = COHERENT if method == FAST else method
    work.mkdir(parents=True, exist_ok=True)
    calibration = load_calibration(kept / CALIBRATION)
    path = work / "recording.h5"
    if not path.exists():
        job = RecordingJob(profile, device, LEVELS, seed, truth=False, out=path)
        job.claim(force=False)
        job.run(CALIBRATED + MATCHED_PAGES + JUDGED)
    with Recording.open(path) as recording:
        decoder = _decoder(trained, profile, calibration, recording, localizer, refinements)
        references, mask = recording.references(), pilot_mask(profile)
        judged = range(CALIBRATED + MATCHED_PAGES, recording.pages)
        run = Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=calibration.to_toml(),
            hyperparameters=decoder.choices,
            camera_bit_depth=recording.bit_depth,
            trained_pages=tuple(hash_frames(recording.frames(page)) for page in judged),
            validation_air=_validation_air(trained, refinements),
            kappa_scale=_kappa_scale(decoder, profile, calibration, recording, judged),
            seconds=0.0,
            provenance={"command": f"python -m analysis.comparison.kept_bundle --kept {kept.name}", "seed": seed},
        )
        save_weights(decoder.state_dict(), work)
        save_arrays(
            work / REFERENCES,
            {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": mask},
        )
        golden = recording.frames(judged[0])
        save_arrays(work / GOLDEN, {"in_phase": golden.in_phase, "quadrature": golden.quadrature})
    run.save(work)
    export_run(work, out, name=kept.name, version="kept")


def _decoder(
    trained: Path, profile: Profile, calibration: Calibration, recording: Recording, localizer: str, refinements: int
) -> SymbolDecoder:
    """The trained decoder, put together as training does it."""
    begun = renamed(json.loads((trained / BEGUN).read_text()))
    options = {name: value for name, value in begun.items() if name != "format"} | {"refinements": refinements}
    choices = Hyperparameters(**options)
    decoder = SymbolDecoder(profile, calibration.vector, localizer, choices)
    decoder.network.load_state_dict(read_weights(trained / KEPT_WEIGHTS))
    if refinements:
        extractor = FeatureExtractor(CalibratedDevice.of(profile, calibration, recording.references()), localizer)
        pages = known_pages(recording, profile, range(CALIBRATED, CALIBRATED + MATCHED_PAGES))
        decoder.prediction = fit_prediction(extractor, explained(extractor, pages))
        decoder.refiners[0].load_state_dict(read_weights(trained / "refinement-1" / KEPT_WEIGHTS))
    return decoder.float().eval()


def _validation_air(trained: Path, refinements: int) -> float:
    folder = trained / f"refinement-{refinements}" if refinements else trained
    return float(json.loads((folder / FITTED).read_text())["validation_air"])


def _kappa_scale(
    decoder: SymbolDecoder, profile: Profile, calibration: Calibration, recording: Recording, pages: range
) -> float:
    """Factor on p under which pages are most likely, their piston off."""
    table = sampling_table(TorchTwin(RayTwin(profile)), calibration.vector, calibration.turn_rad, profile)
    graph = DecoderGraph(profile, decoder, 1.0).eval()
    tensors = table_tensors(graph, table, recording.references())
    mask, shown, truths = pilot_mask(profile), [], []
    for page in pages:
        symbols = recording.symbols(page)
        assert symbols is not None
        truth = symbol_phases(symbols, LEVELS).astype(np.float32)
        p = torch_answer(graph, recording.frames(page), tensors)["p"]
        shown.append(without_piston(p, truth, mask)[:, ~mask])
        truths.append(truth[~mask])
    return calibrating_factor(np.concatenate(shown, axis=1), np.concatenate(truths))


@click.command()
@click.option("--kept", required=True, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--method", default=COHERENT, show_default=True, help="fast, or the localizer of a method.")
@click.option("--refinements", default=1, show_default=True, type=click.IntRange(0, 1))
@click.option("--work", default=Path("runs/kept-bundle"), show_default=True, type=OutputFolder())
@click.option("--out", required=True, type=NewPath())
def main(kept: Path, method: str, refinements: int, work: Path, out: Path) -> None:
    """Export a kept method of the comparison as a bundle."""
    export_kept(kept, work / kept.name, out, method, refinements)
    click.echo(out)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.comparison.kept_bundle"))
