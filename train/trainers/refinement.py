"""A further pass: what the decoded page would have shown, against what was seen.

A first pass knows neither |E|^2 nor what neighbouring symbols spill into a symbol. Once most is decoded, the wave model
says both: the expected page is sent through the device, its light is taken off both frames with each measurement
weighted by what it tells at that light, and what remains is brought back to the page. That is one step of Gauss and
Newton towards the most likely page; a small network takes it, for the waves are not quite the device's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import torch
from torch import nn

from lightpage.recording.reader import Recording
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.features import FeatureExtractor, PageFeatures, on_device
from lightpage.train.data.known_light import Explained
from lightpage.train.data.patches import training_pages
from lightpage.train.fitting.fit import fit_network
from lightpage.train.fitting.fitted import Fitted
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import Refiner
from lightpage.train.models.parts import stacked, turned
from lightpage.train.models.prediction import Prediction
from lightpage.train.processes import AS_IT_IS, Processes

_FLOORS = (0.05, 20.0)
"""Least and largest `Measured.pull` floor that is accepted."""


def fit_prediction(extractor: FeatureExtractor, known: Sequence[Explained]) -> Prediction:
    """The prediction of a device, illumination and floor as known pages show them.

    Args:
        extractor: extractor of the device.
        known: pages, as `explained` gives them for that extractor.
    """
    prediction = Prediction(extractor.device.profile, extractor.device.parameters, extractor.grid)
    squares, lengths = [], []
    for light in known:
        measured, seen = light.measured, light.seen
        e = stacked(light.expected) / measured.amplitude
        for left, arm in zip(measured.left(e), (1.0, complex(measured.cos, measured.sin)), strict=True):
            squares.append(left.numpy()[seen] ** 2)
            lengths.append(np.abs(arm + e[0].numpy() + 1j * e[1].numpy())[seen] ** 2)
    # an equation's variance is that of a photon count times (|arm + e|^2 + floor)
    by_light, constant = np.polyfit(np.concatenate(lengths), np.concatenate(squares), 1)
    floor = constant / by_light if by_light > 0 else np.inf
    prediction.illumination.copy_(stacked(np.mean([light.illumination for light in known], axis=0)))
    prediction.floor.fill_(float(np.clip(floor, *_FLOORS)))
    return prediction


@dataclass(frozen=True)
class Refined:
    """Trained refinements.

    Attributes:
        trained: their trainings, in order.
        validation: features of the validation pages for this refinement.
        seconds: seconds of features and training, all stretches together.
    """

    trained: list[Fitted[SymbolTraining]]
    validation: FeatureStore
    seconds: float

    @property
    def last(self) -> Fitted[SymbolTraining]:
        """The last one's training."""
        return self.trained[-1]


@dataclass(frozen=True)
class RefinementPages:
    """Recorded pages that refinements are trained on.

    Attributes:
        recording: recording with their frames.
        pages: page numbers: those trained on, those validated on, then others.
        training, validation: how many of them.
        features: their features for the first pass, in the same order.
    """

    recording: Recording
    pages: list[int]
    training: int
    validation: int
    features: Path


def fit_refinements(
    folder: Path,
    choices: Hyperparameters,
    inputs: RefinementPages,
    extractor: FeatureExtractor,
    prediction: Prediction,
    first: Fitted[SymbolTraining],
    key: str,
    starts: Iterable[nn.Module] = (),
    processes: Processes = AS_IT_IS,
) -> Refined:
    """Train, or go on with, the refinements of a run, one behind the other.

    Args:
        folder: folder of the run.
        choices: the run's; `choices.refinements` of them, at least one.
        inputs: pages.
        extractor, prediction: extractor and prediction of the device.
        first: the first pass's training.
        key: everything that the first pass's features depend on.
        starts: networks whose weights the first of them begin with.
        processes: see `fit_network`.
    """
    passes, features, seconds = [first], inputs.features, 0.0
    validation = FeatureStore(features, range(0))
    count, seen = len(inputs.pages), inputs.training + inputs.validation
    chosen = choices.of_refinement()
    for number, start in zip(range(1, choices.refinements + 1), chain(starts, repeat(None)), strict=False):
        make = partial(refined_pages, extractor, prediction, inputs, FeatureStore(features), passes[-1].module)
        at = folder / f"refinement-{number}"
        features = at / "features"
        key = f"{key} {number} {passes[-1].validation_air}"

        seconds += fill(features, key, count, make, f"pages of refinement {number}")
        training, validation = (
            FeatureStore(features, part) for part in (range(inputs.training), range(inputs.training, seen))
        )
        mask, levels = first.module.pilot_mask, first.module.levels
        patches = training_pages([training], mask, chosen, levels)
        passes.append(
            fit_network(at, chosen, mask, levels, patches, validation, kind=Refiner, start=start, processes=processes)
        )
        seconds += passes[-1].seconds
    return Refined(passes[1:], validation, seconds)


def refined_pages(
    extractor: FeatureExtractor,
    prediction: Prediction,
    inputs: RefinementPages,
    earlier: FeatureStore,
    module: SymbolTraining,
    start: int,
    shift_px: tuple[float, float],
) -> Iterator[PageFeatures]:
    """Features for a refinement, computed where the extractor computes.

    Args:
        extractor, prediction: extractor and prediction of the device.
        inputs: pages.
        earlier: their features for the pass before.
        module: module that was trained on such features.
        start: first page.
        shift_px: not asked for: the pass before has found each page's.
    """
    there, recovery = extractor.compute, extractor.recovery_there
    prediction, network = on_device(prediction, there), on_device(module.network, there)
    for number in range(start, len(inputs.pages)):
        *shown, phases = earlier[number]
        state, pair = earlier.state(number), inputs.recording.frames(inputs.pages[number])
        exact = torch.backends.cudnn.flags(enabled=True, allow_tf32=False)  # its 10 bits would be seen
        with torch.no_grad(), exact:
            light, *others = (part[None].to(there) for part in shown)
            estimate = network(light.float(), *others)[0]
            measured, field = extractor.measure(pair, state.shift_px, recovery)
            left = prediction(recovery, measured, field, turned(estimate, state.piston_rad))
        yield PageFeatures(
            turned(left, -state.piston_rad).cpu().numpy().astype(np.float16),
            shown[1].numpy(),
            phases.numpy(),
            state,
            estimate.cpu().numpy(),
        )
