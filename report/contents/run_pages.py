"""The decoder of a finished training run and the pages that it was validated by."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray
from torch import nn
from torch.utils.data import Dataset

from lightpage.errors import InvalidInputError, RecordingError
from lightpage.page.levels import MAX_LEVELS
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import page_hashes
from lightpage.recording.reader import Recording
from lightpage.train.data.feature_store import FeatureStore
from lightpage.train.data.features import PageState
from lightpage.train.data.pages import Page
from lightpage.train.fitting.modules import DecoderTraining, SymbolTraining
from lightpage.train.models.network import Refiner, SymbolUNet
from lightpage.train.published.trainer import published_decoder
from lightpage.train.published.training import FramePages, PublishedChoices, PublishedTraining
from lightpage.train.runs import Run, load_decoder, load_weights


class Decodable(NamedTuple):
    """Decoder in training form, with validation pages as it takes them, and its number of parameters."""

    module: DecoderTraining[Any]
    pages: Dataset[Page]
    parameters: int


@contextmanager
def decodable(
    folder: Path, run: Run, kept: dict[str, NDArray[Any]], recording_path: Path | None
) -> Iterator[Decodable]:
    """The trained decoder and the validation pages, as long as the recording is open."""
    choices = run.hyperparameters
    if recording_path is None:
        if isinstance(choices, PublishedChoices):
            expected = f"the recording of the run: its decoder, {run.localizer}, reads camera frames"
            raise InvalidInputError("--recording", "none", expected)
        yield _at_symbol_pitch(folder, run, kept)
        return
    with Recording.open(recording_path) as recording:
        validation = validation_pages(run, recording)
        if not isinstance(choices, PublishedChoices):
            yield _at_symbol_pitch(folder, run, kept)
            return
        references = FramePair(kept["in_phase"], kept["quadrature"])
        decoder = published_decoder(run.localizer, choices, run.profile, references, run.calibration.turn_rad)
        pages = FramePages(recording, validation, _states(folder, run), run.calibration.modulator)
        module = PublishedTraining(load_weights(folder, decoder), choices, kept["pilots"], pages.levels)
        yield Decodable(module, pages, _size(decoder))


def _at_symbol_pitch(folder: Path, run: Run, kept: dict[str, NDArray[Any]]) -> Decodable:
    first, validated, _ = run.pages
    choices = run.hyperparameters
    assert not isinstance(choices, PublishedChoices)
    try:
        store = FeatureStore(passes_of(folder, run)[-1] / "features", range(first, first + validated))
        _ = store[0]
    except (OSError, ValueError, IndexError) as error:
        raise InvalidInputError(f"run {folder}: features", error, "the features that training left there") from None
    decoder = load_decoder(folder, run)
    network = decoder.refiners[-1] if choices.refinements else decoder.network
    assert isinstance(network, SymbolUNet | Refiner)
    size = _size(decoder.network) + _size(decoder.refiners)
    return Decodable(SymbolTraining(network, choices, kept["pilots"], MAX_LEVELS), store, size)


def passes_of(folder: Path, run: Run) -> list[Path]:
    """Folders of all that was trained, one pass behind the other."""
    choices = run.hyperparameters
    again = 0 if isinstance(choices, PublishedChoices) else choices.refinements
    return [folder, *(folder / f"refinement-{number}" for number in range(1, again + 1))]


def validation_pages(run: Run, recording: Recording) -> list[int]:
    """Find the validation pages of a run in its recording, and return their numbers there.

    Raises:
        RecordingError: it is not that recording.
    """
    recording.header.check_against(run.profile)
    subject = f"recording {recording.path}"
    if not recording.has_symbols:
        raise RecordingError(subject, "no symbols", "the recording that the run was trained on")
    expected = run.trained_pages[run.pages[0] :]
    found: dict[str, int] = {}
    for page in range(recording.pages):
        for page_hash in page_hashes(recording.frames(page)):
            found.setdefault(page_hash, page)
        if all(page_hash in found for page_hash in expected):
            return [found[page_hash] for page_hash in expected]
    there = f"{sum(page_hash in found for page_hash in expected)} of {len(expected)} validation pages"
    raise RecordingError(subject, there, "the recording that the run was trained on")


def _states(folder: Path, run: Run) -> list[PageState]:
    path = folder / "states.json"
    try:
        kept = json.loads(path.read_text("utf-8"))["states"][run.pages[0] :]
        return [PageState((s["shift_px"][0], s["shift_px"][1]), s["piston_rad"]) for s in kept]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"states {path}", error, "the states of the pages that training left there") from None


def _size(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())
