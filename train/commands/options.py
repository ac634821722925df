"""Options of `lightpage train` for a decoder and its training: one table, read by the command."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import click

from lightpage.device.profile import Profile, load_profile
from lightpage.errors import InvalidInputError
from lightpage.train.fitting.precision import PRECISIONS
from lightpage.train.models.decoder import LOCALIZERS, WAVE
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.localizers.coherent import BICUBIC, BILINEAR
from lightpage.train.models.presets import ACCURATE, FAST, PRESETS
from lightpage.train.published.decoder import LENS_CHOICES
from lightpage.train.published.localizers import NAMES as PUBLISHED
from lightpage.train.published.trainer import PublishedTrainer, published_choices
from lightpage.train.published.training import PublishedChoices
from lightpage.train.trainers.symbols import SymbolTrainer, default_synthetic_pages
from lightpage.waves.grid import GRID_STEP_PX

ACCEPT = "--accept-wrong-fit"
"""Option of commands that else refuse a calibration whose fit is wrong."""
_ALL = (*PUBLISHED, *LOCALIZERS)
_COHERENT = tuple(name for name in LOCALIZERS if name != WAVE)


@dataclass(frozen=True)
class Choice:
    """An option that says how to train.

    Attributes:
        flag: name on the command line.
        type: click's.
        what: effect of the option.
        default: value without the option at symbol pitch; that of `Hyperparameters` if left out.
        published: value without the option for the published decoders, where they have it.
        localizers: localizers that have the option.
        of_preset: whether it is set by `--preset`; `--help` does not list it then, but it may be given too.
    """

    flag: str
    type: click.ParamType[Any] | type
    what: str
    default: object = None
    published: object = None
    localizers: tuple[str, ...] = _ALL
    of_preset: bool = False

    @property
    def name(self) -> str:
        """Name of the command's parameter."""
        return self.flag.removeprefix("--").replace("-", "_")

    @property
    def help(self) -> str:
        """Help text of the option, followed by its default."""
        if self.localizers == PUBLISHED:
            return f"{self.what} [default: {self.published}; only with {', '.join(PUBLISHED)}]"
        value = getattr(Hyperparameters, self.name) if self.default is None else self.default
        usual = format(value, "g") if isinstance(value, float) else value
        if self.localizers != _ALL:
            return f"{self.what} [default: {usual}; only with {', '.join(self.localizers)}]"
        return f"{self.what} [default: {usual}" + (f"; published: {self.published}]" if self.published else "]")


CHOICES = (
    Choice(
        "--preset",
        click.Choice(list(PRESETS)),
        "Decoder by its time for a page: one quick pass, one pass, or two passes.",
        ACCURATE,
        localizers=LOCALIZERS,
    ),
    Choice(
        "--steps",
        click.IntRange(min=10),
        "Optimiser steps: 300 for a first try, thousands for all that a device gives.",
        published="50 passes over the pages, fewer for symbols larger than 4x4",
    ),
    Choice(
        "--batch", click.IntRange(min=1), "Pages, or patches of large ones, a step.", published=PublishedChoices.batch
    ),
    Choice(
        "--patch",
        click.IntRange(min=16),
        "Larger pages are trained on in patches with so many symbols along an edge.",
        localizers=LOCALIZERS,
    ),
    Choice(
        "--channels",
        click.IntRange(min=4),
        "Channels of the network.",
        published="32, and twice as many below sample pitch",
    ),
    Choice(
        "--blocks",
        click.IntRange(min=1),
        "Residual blocks of the network, at each of its resolutions.",
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--depth",
        click.IntRange(min=0, max=4),
        "Number of times that the network halves its resolution below symbol pitch; 0 is the flat one.",
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--refinements",
        click.IntRange(min=0, max=4),
        "Further passes, for what the symbols decoded so far do not explain.",
        PRESETS[ACCURATE].choices.refinements,
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--reflections",
        click.IntRange(min=0, max=20),
        "Rounds of averaged reflections to the field; 0 for descent.",
        PRESETS[ACCURATE].choices.reflections,
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--field-rounds",
        click.IntRange(min=0, max=20),
        "Rounds of descent to the field, in place of --reflections: fewer are faster, and lose most in bright light.",
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--binning",
        click.IntRange(min=1, max=2),
        "Camera pixels along each axis whose mean is sampled, instead of filtering frames first: 2 is quicker and less "
        "exact.",
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--field-step",
        click.IntRange(min=GRID_STEP_PX),
        "Camera pixels from one sample of the field to the next: more are quicker and less exact.",
        localizers=LOCALIZERS,
        of_preset=True,
    ),
    Choice(
        "--samples",
        click.IntRange(min=0, max=16),
        "Samples per symbol and axis that the localizer reads; 0 takes as many as the field has.",
        localizers=_COHERENT,
        of_preset=True,
    ),
    Choice(
        "--interpolation",
        click.Choice([BICUBIC, BILINEAR]),
        "Interpolation between the field's samples: bilinear is quicker and less exact.",
        localizers=_COHERENT,
        of_preset=True,
    ),
    Choice(
        "--lenses",
        click.Choice(LENS_CHOICES),
        "Lenses that the published rays are traced through.",
        published="those of the profile",
        localizers=PUBLISHED,
    ),
    Choice(
        "--held-share",
        click.FloatRange(0, 1, max_open=True),
        "Share of the steps over which registration and angle stay as they begin. The authors let them go at once.",
        published="0",
        localizers=PUBLISHED,
    ),
    Choice(
        "--learning-rate",
        float,
        "Peak learning rate of the one-cycle schedule, or the published network's rate.",
        published=f"{PublishedChoices.decoder_rate:g}",
    ),
    Choice(
        "--precision",
        click.Choice(PRECISIONS),
        "Precision of the network's arithmetic; auto is bf16-mixed where the processor has it, else 32-true.",
    ),
    Choice("--seed", click.IntRange(min=0), "Seed of initial weights, batches and rotations."),
    Choice(
        "--synthetic-pages",
        click.IntRange(min=0),
        "Pages that the fitted device would show after drifts, trained on beside the recorded ones.",
        f"{default_synthetic_pages(load_profile('bench'))}, of larger pages fewer",
        localizers=LOCALIZERS,
    ),
    Choice(
        "--start",
        click.Path(path_type=Path),
        "Finished run whose weights this one begins with.",
        "random ones",
        localizers=LOCALIZERS,
    ),
)

C = TypeVar("C", bound=Callable[..., Any])


def with_choices(command: C) -> C:
    """Give a command the options of `CHOICES`; what is not given comes as None."""
    for choice in reversed(CHOICES):
        command = click.option(choice.flag, choice.name, type=choice.type, help=choice.help, hidden=choice.of_preset)(
            command
        )
    return command


def chosen_localizer(localizer: str | None, preset: str | None) -> str:
    """The localizer: the preset's where none is chosen, and the default preset's where that is not chosen either."""
    return PRESETS[preset or ACCURATE].localizer if localizer is None else localizer


def given_choices(localizer: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of `CHOICES` that were given, by name.

    Raises:
        InvalidInputError: an option that the localizer does not have, or one that cannot be.
    """
    given = {name: value for name, value in options.items() if value is not None}
    for choice in CHOICES:
        if choice.name in given and localizer not in choice.localizers:
            raise InvalidInputError(choice.flag, given[choice.name], f"no such option with --localizer {localizer}")
    rate, held = given.get("learning_rate", 1.0), given.get("held_share", 0.0)
    if not (math.isfinite(rate) and rate > 0):
        raise InvalidInputError("--learning-rate", rate, "a positive number")
    if not math.isfinite(held):
        raise InvalidInputError("--held-share", held, "a number")
    return given


def chosen_trainer(
    localizer: str, profile: Profile, pages: int, given: dict[str, Any]
) -> SymbolTrainer | PublishedTrainer:
    """The way of training that was chosen; what was not stays as it is by default, or as its authors had it.

    Args:
        localizer: name.
        profile: the nominal device.
        pages: number of pages to train on.
        given: see `given_choices`.

    Raises:
        InvalidInputError: a run to start from that is not finished, or of another size; a grid too coarse for the
            device.
    """
    given = dict(given)
    if localizer in PUBLISHED:
        return _published(localizer, published_choices(localizer, profile, pages, given.pop("batch", None)), given)
    synthetic = given.pop("synthetic_pages", default_synthetic_pages(profile))
    start = given.pop("start", None)
    preset = given.pop("preset", ACCURATE)
    if preset == FAST and localizer not in _COHERENT:
        raise InvalidInputError(f"--preset {FAST}", f"--localizer {localizer}", f"--localizer {' or '.join(_COHERENT)}")
    if "field_rounds" in given:
        given.setdefault("reflections", 0)
    choices = replace(PRESETS[preset].choices, **given)
    choices.grid(profile)
    trainer = SymbolTrainer(localizer, choices, synthetic, start)
    trainer.check_start(profile)
    return trainer


def _published(localizer: str, defaults: PublishedChoices, given: dict[str, Any]) -> PublishedTrainer:
    if "channels" in given:
        given["channels"] = (given["channels"], 2 * given["channels"])
    if "learning_rate" in given:
        given["decoder_rate"] = given.pop("learning_rate")
    return PublishedTrainer(localizer, replace(defaults, **given))
