"""Files of a finished training in its run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Generic, TypeVar

import torch

from lightpage.errors import InvalidInputError
from lightpage.files import replace_file, replace_text
from lightpage.metrics.provenance import PROVENANCE
from lightpage.train.fitting.curves import Curve
from lightpage.train.fitting.modules import DecoderTraining
from lightpage.train.fitting.provenance import provenance_of

CHECKPOINTS = "checkpoints"
"""Folder of a run's checkpoints."""

FITTED, FITTED_WEIGHTS = "fitted.json", "fitted.pt"
"""Files of a run whose training is finished: what it reached, and the weights. They stand in for its checkpoints."""

_WANTED = f"{FITTED} and {FITTED_WEIGHTS} of one training, or neither, to train from the last checkpoint on"

KEPT_POINTS = 60
"""Points of each curve that a finished training keeps."""

M = TypeVar("M", bound=DecoderTraining[Any])


@dataclass(frozen=True)
class Fitted(Generic[M]):
    """A trained module.

    Attributes:
        module: the best one, in float32.
        validation_air: AIR on the validation pages, bits per data symbol.
        seconds: seconds of training, all stretches of an interrupted run together.
        curves: curves of `lightpage.train.fitting.curves.CURVES`, thinned.
    """

    module: M
    validation_air: float
    seconds: float
    curves: dict[str, Curve]

    def save(self, run: Path) -> None:
        """Keep it in the folder of its run, weights first: what is said to be finished is whole."""
        replace_file(run / FITTED_WEIGHTS, partial(torch.save, self.module.network.state_dict()), "weights")
        kept = {"validation_air": self.validation_air, "seconds": self.seconds, PROVENANCE: provenance_of(run)}
        kept["curves"] = self.curves
        replace_text(run / FITTED, json.dumps(kept, indent=1) + "\n", "result of a training")


def is_finished(run: Path) -> bool:
    """Return whether the training of a run has ended, and its result is there."""
    return (run / FITTED).exists()


def finished(run: Path, module: M) -> Fitted[M] | None:
    """Return what an earlier call of `fit` made of the run's module, None if it is not there.

    Raises:
        InvalidInputError: it is damaged, or of another module.
    """
    if not is_finished(run):
        return None
    kept = _kept(run)
    try:
        module.network.load_state_dict(torch.load(run / FITTED_WEIGHTS, map_location="cpu", weights_only=True))
    except (OSError, RuntimeError, EOFError, UnpicklingError) as error:
        raise InvalidInputError(f"finished training {run / FITTED_WEIGHTS}", error, _WANTED) from None
    return Fitted(module.float().eval(), **kept)


def fitted_curves(run: Path) -> dict[str, Curve]:
    """The curves that a finished training kept, thinned; none of another run.

    Raises:
        InvalidInputError: what it kept is damaged.
    """
    return _kept(run)["curves"] if is_finished(run) else {}


def _kept(run: Path) -> dict[str, Any]:
    """Read the figures of a finished training, by the names of `Fitted`."""
    try:
        kept = json.loads((run / FITTED).read_text("utf-8"))
        curves = {str(name): [(int(step), float(value)) for step, value in c] for name, c in kept["curves"].items()}
        return {"validation_air": float(kept["validation_air"]), "seconds": float(kept["seconds"]), "curves": curves}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidInputError(f"finished training {run / FITTED}", repr(error), _WANTED) from None
