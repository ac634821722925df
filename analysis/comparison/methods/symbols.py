"""Methods at symbol pitch: features once, then a network over them, and further passes where the method has some."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from analysis.comparison.data_set import recorded
from analysis.comparison.levels import LevelFigures, level_figures
from analysis.comparison.methods.bench import ORACLE, Bench
from analysis.comparison.methods.judgement import decoded, judged
from analysis.comparison.outcome import Outcome
from lightpage.calibration.known_pages import known_pages
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.known_light import explained
from lightpage.train.data.patches import training_pages
from lightpage.train.fitting.fit import fit_network
from lightpage.train.fitting.fitted import Fitted
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.models.decoder import LOCALIZERS
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.prediction import Prediction
from lightpage.train.models.presets import FAST, PRESETS
from lightpage.train.processes import ONE
from lightpage.train.trainers.refinement import RefinementPages, fit_prediction, fit_refinements, refined_pages
from lightpage.train.trainers.symbols import MATCHED_PAGES

REFINED = "refined"
WAVE_REFINED = "wave-refined"
ORACLE_REFINED = "oracle-refined"
FIRST_PASSES = {REFINED: "coherent", WAVE_REFINED: "wave", ORACLE_REFINED: ORACLE}
"""Methods that make another pass, and the method whose first pass they share."""

SYMBOL_METHODS = (*LOCALIZERS, FAST, REFINED, WAVE_REFINED, ORACLE, ORACLE_REFINED)
LEVEL_PAGES = 4
"""Pages of each number of levels, as many as are calibrated on: thirty thousand symbols on the bench device."""


def symbol_method(bench: Bench, name: str, size: str, choices: Hyperparameters) -> Outcome:
    """Features, then the network at symbol pitch."""
    if name == FAST:
        choices = replace(PRESETS[FAST].choices, steps=choices.steps, seed=choices.seed)
        size = f"{choices.channels}x{choices.blocks}x{choices.depth}"
    else:
        channels, blocks, depth = map(int, size.split("x"))
        choices = replace(choices, channels=channels, blocks=blocks, depth=depth)
    base = FIRST_PASSES.get(name, name)
    folder, features, first, preparing = first_pass(bench, base, size, choices)
    bench.kept.keep(folder, first, bench.held_out(features)[0])
    if name not in FIRST_PASSES:
        drawn = choices.drawn(bench.profile.page_shape)
        held_out = bench.held_out(features)
        outcome = judged(bench, name, size, choices.steps, folder, first, *held_out, preparing, drawn)
        return replace(outcome, by_levels=at_levels(bench, name, folder, [first], outcome.kappa_scale))
    extractor = bench.extractor(base)
    pages = known_pages(bench.recording, bench.profile, bench.training[:MATCHED_PAGES])
    prediction = fit_prediction(extractor, explained(extractor, pages))
    counts = len(bench.training), len(bench.validation)
    inputs = RefinementPages(bench.recording, bench.pages, *counts, features)
    key = bench.key(base)
    refined = fit_refinements(folder, choices, inputs, extractor, prediction, first, key, processes=ONE)
    for number, one in enumerate(refined.trained, 1):
        run = folder / f"refinement-{number}"
        bench.kept.keep(run, one, bench.held_out(run / "features")[0])
    at = folder / f"refinement-{choices.refinements}"
    held_out = bench.held_out(at / "features")
    preparing = refined.seconds - sum(one.seconds for one in refined.trained)
    again = choices.of_refinement()
    drawn = again.drawn(bench.profile.page_shape)
    method = f"{name} {choices.refinements}"
    outcome = judged(bench, method, size, again.steps, at, refined.last, *held_out, preparing, drawn)
    passes = [first, *refined.trained]
    by_levels = at_levels(bench, base, at, passes, outcome.kappa_scale, prediction)
    return replace(outcome, passes=len(passes), by_levels=by_levels)


def first_pass(
    bench: Bench, name: str, size: str, choices: Hyperparameters
) -> tuple[Path, Path, Fitted[SymbolTraining], float]:
    """Run, features, trained network, and seconds that the features took."""
    features = bench.out / name / "features"
    make = partial(bench.features_of, name, bench.recording, bench.pages)
    preparing = fill(features, bench.key(name), len(bench.pages), make, f"features of {name}")
    training, (validation, _) = FeatureStore(features, range(len(bench.training))), bench.held_out(features)
    patches = training_pages([training], bench.mask, choices, bench.levels_of(name))
    folder = bench.begun(bench.out / name / f"{size}-{choices.steps}", asdict(replace(choices, refinements=0)))
    return (
        folder,
        features,
        fit_network(folder, choices, bench.mask, bench.levels_of(name), patches, validation, processes=ONE),
        preparing,
    )


def at_levels(
    bench: Bench,
    name: str,
    folder: Path,
    passes: list[Fitted[SymbolTraining]],
    scale: float,
    prediction: Prediction | None = None,
) -> list[LevelFigures]:
    """Measure what a decoder is worth among fewer levels, on recordings of their own."""
    found = []
    for levels in bench.levels:
        at = folder / f"levels-{levels}"
        with recorded(
            bench.profile, bench.device, LEVEL_PAGES, bench.seed + levels, bench.out / at.name, levels
        ) as pages:
            numbers = list(range(pages.pages))
            make_first = partial(bench.features_of, name, pages, numbers)
            fill(at / "pass-0", bench.key(name), len(numbers), make_first, f"pages of {levels} levels")
            for number in range(1, len(passes)):
                assert prediction is not None
                earlier = at / f"pass-{number - 1}"
                inputs = RefinementPages(pages, numbers, len(numbers), 0, earlier)
                make = partial(
                    refined_pages,
                    bench.extractor(name),
                    prediction,
                    inputs,
                    FeatureStore(earlier),
                    passes[number - 1].module,
                )
                key = f"{bench.key(name)} {passes[number - 1].validation_air}"
                fill(at / f"pass-{number}", key, len(numbers), make, f"pass {number} over pages of {levels} levels")
            last = FeatureStore(at / f"pass-{len(passes) - 1}")
            found.append(level_figures(decoded(bench, passes[-1].module, last, scale), pages, numbers, bench.mask))
    return found
