"""Calibrations and trained methods that need not be made again: some take hours, and they are small.

They lie in a folder for each data set, whose `begun.json` says what it is, and there in a folder for each run, whose
`begun.json` says with which options it was begun.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import Dataset

from analysis.comparison.kept_weights import read_weights, steps, write_weights
from lightpage.errors import InvalidInputError
from lightpage.files import replace_file
from lightpage.run_files import BEGUN
from lightpage.train.data.pages import Page
from lightpage.train.fitting.fitted import CHECKPOINTS, FITTED, FITTED_WEIGHTS, Fitted
from lightpage.train.runs import FORMAT, renamed

TRAINED = Path(__file__).parents[1] / "weights"
CALIBRATION = "calibration.toml"
KEPT_WEIGHTS = "fitted.xz"
"""File of a kept run, in place of its `FITTED_WEIGHTS`."""


@dataclass(frozen=True)
class WeightStore:
    """Store of what was trained on a data set: its calibration and the methods' weights.

    Attributes:
        data_set: folder of the data set, with its recording.
        folder: folder of the store, which need not be there.
        adds: whether what is trained now is to be kept too.
    """

    data_set: Path
    folder: Path
    adds: bool = False

    @property
    def is_of_this_data_set(self) -> bool:
        """Return whether the store holds this very data set: the same device, pages, seed and format of the code."""
        return (self.folder / BEGUN).exists() and _read(self.folder / BEGUN) == _read(self.data_set / BEGUN)

    def bring_calibration(self) -> None:
        """Copy the calibration to where it would be made again; one that is there stays.

        Raises:
            InvalidInputError: things are to be kept, where something of another data set is kept.
        """
        if self.adds and (self.folder / BEGUN).exists() and not self.is_of_this_data_set:
            expected = "device, pages and seed of what is kept there, or another --trained"
            raise InvalidInputError(f"--keep in {self.folder}", "another data set", expected)
        if self.is_of_this_data_set and not (self.data_set / CALIBRATION).exists():
            _copy(self.folder / CALIBRATION, self.data_set / CALIBRATION)

    def bring(self, run: Path, options: dict[str, Any]) -> bool:
        """Copy a trained run, and what was trained on it, to where it would be trained again.

        Nothing is taken where training has begun, or that was begun with other options or another calibration.

        Args:
            run: folder of the run below the data set's.
            options: options with which it would be begun.

        Returns:
            Whether it was copied.
        """
        kept = self.folder / run.relative_to(self.data_set)
        if (run / FITTED).exists() or (run / CHECKPOINTS).exists() or not (kept / FITTED).exists():
            return False
        if not self.is_of_this_data_set or renamed(_read(kept / BEGUN)) != {"format": FORMAT, **options}:
            return False
        if (self.folder / CALIBRATION).read_text() != (self.data_set / CALIBRATION).read_text():
            return False
        place(kept, run)
        return True

    def keep(self, run: Path, trained: Fitted[Any], pages: Dataset[Page]) -> None:
        """Keep a trained run, if that was wanted, as small as `pages` allow (`analysis.comparison.kept_weights`).

        A refinement of it is kept by a call of its own.

        Raises:
            InvalidInputError: another data set, another calibration, or another training with the same options is kept.
        """
        if not self.adds:
            return
        _copy_or_check(self.data_set / BEGUN, self.folder / BEGUN)
        _copy_or_check(self.data_set / CALIBRATION, self.folder / CALIBRATION)
        kept = self.folder / run.relative_to(self.data_set)
        if not (kept / FITTED).exists():
            kept.mkdir(parents=True, exist_ok=True)
            if (run / BEGUN).exists():
                _copy(run / BEGUN, kept / BEGUN)
            weights = trained.module.network.state_dict()
            write_weights(kept / KEPT_WEIGHTS, weights, steps(trained.module, pages))
        _copy_or_check(run / FITTED, kept / FITTED)


def place(kept: Path, run: Path) -> None:
    """Put a kept run, and what was trained on it, where training leaves them; what says that it is finished, last."""
    for path in sorted(kept.rglob(KEPT_WEIGHTS)):
        to = run / path.parent.relative_to(kept)
        to.mkdir(parents=True, exist_ok=True)
        replace_file(to / FITTED_WEIGHTS, partial(torch.save, read_weights(path)), "weights")
    for name in (BEGUN, FITTED):
        for path in sorted(kept.rglob(name)):
            _copy(path, run / path.relative_to(kept))


def _copy(path: Path, to: Path) -> None:
    """Copy a small file, whole or not at all."""
    to.parent.mkdir(parents=True, exist_ok=True)
    content = path.read_bytes()
    replace_file(to, lambda file: file.write(content))


def _copy_or_check(path: Path, to: Path) -> None:
    if not to.exists():
        _copy(path, to)
    elif to.read_bytes() != path.read_bytes():
        raise InvalidInputError(f"--keep of {path}", f"another one in {to}", "the same one, or another --trained")


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"options {path}", error, "the JSON that was written when the work began") from None
