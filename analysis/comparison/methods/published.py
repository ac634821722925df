"""The published methods: decoders that read raw frames."""

from __future__ import annotations

from analysis.comparison.methods.bench import Bench
from analysis.comparison.methods.judgement import judged
from analysis.comparison.outcome import Outcome
from lightpage.train.processes import ONE
from lightpage.train.published.states import page_states
from lightpage.train.published.trainer import train_published
from lightpage.train.published.training import FramePages, PublishedChoices


def published_method(bench: Bench, name: str, choices: PublishedChoices) -> Outcome:
    """States of the pages, then a published decoder on raw frames."""
    states, preparing = page_states(
        bench.out / "states.json", bench.fitted.to_toml(), bench.recording, bench.extractor("coherent"), bench.pages
    )
    by_page = dict(zip(bench.pages, states, strict=True))
    training, validation, unseen = (
        FramePages(bench.recording, part, [by_page[page] for page in part])
        for part in (bench.training, bench.validation, bench.unseen)
    )
    size = "/".join(map(str, choices.channels))
    folder = bench.begun(bench.out / name / f"{size.replace('/', '-')}-{choices.steps}", choices.kept())
    phase = bench.fitted.turn_rad
    trained = train_published(
        folder, name, choices, bench.profile, phase, bench.mask, training, validation, processes=ONE
    )
    bench.kept.keep(folder, trained, validation)
    drawn = choices.steps * choices.batch
    return judged(bench, name, size, choices.steps, folder, trained, validation, unseen, preparing, drawn)
