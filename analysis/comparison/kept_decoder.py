"""A kept method of the comparison as a decoder, and what its training and its pages say of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from analysis.comparison.data_set import CALIBRATED, LEVELS
from analysis.comparison.kept_weights import read_weights
from analysis.comparison.weight_store import KEPT_WEIGHTS
from lightpage.calibration.document import Calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.profile import Profile
from lightpage.export.graph import DecoderGraph, table_tensors
from lightpage.export.parity import torch_answer
from lightpage.page.symbols import pilot_mask, symbol_phases
from lightpage.recording.reader import Recording
from lightpage.run_files import BEGUN
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.data.known_light import explained
from lightpage.train.fitting.concentration_scale import calibrating_factor
from lightpage.train.fitting.fitted import FITTED
from lightpage.train.fitting.validation import without_piston
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.runs import renamed
from lightpage.train.trainers.refinement import fit_prediction
from lightpage.train.trainers.symbols import MATCHED_PAGES


def kept_decoder(
    trained: Path, profile: Profile, calibration: Calibration, recording: Recording, localizer: str, refinements: int
) -> SymbolDecoder:
    """The trained decoder, put together as training does it."""
    begun = renamed(json.loads((trained / BEGUN).read_text()))
    options = {name: value for name, value in begun.items() if name != "format"} | {"refinements": refinements}
    choices = Hyperparameters(**options)
    decoder = SymbolDecoder(profile, calibration.vector, localizer, choices)
    decoder.network.load_state_dict(read_weights(trained / KEPT_WEIGHTS))
    if refinements:
        extractor = FeatureExtractor(calibration.device(profile, recording.references()), localizer)
        pages = known_pages(recording, profile, range(CALIBRATED, CALIBRATED + MATCHED_PAGES))
        decoder.prediction = fit_prediction(extractor, explained(extractor, pages))
        decoder.refiners[0].load_state_dict(read_weights(trained / "refinement-1" / KEPT_WEIGHTS))
    return decoder.float().eval()


def validation_air(trained: Path, refinements: int) -> float:
    """Return the AIR that a kept decoder had on its validation pages, bits a symbol."""
    folder = trained / f"refinement-{refinements}" if refinements else trained
    return float(json.loads((folder / FITTED).read_text())["validation_air"])


def kappa_scale(
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
        shown.append(without_piston(p, truth, mask, LEVELS)[:, ~mask])
        truths.append(truth[~mask])
    return calibrating_factor(np.concatenate(shown, axis=1), np.concatenate(truths))
