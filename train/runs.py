"""The folder of a training run: what was chosen, what it was trained on, and how far it came."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import zip_longest
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lightpage.calibration.document import Calibration, parse_calibration
from lightpage.device.profile import Profile, parse_profile
from lightpage.errors import InvalidInputError
from lightpage.files import lock, replace_file, replace_text
from lightpage.run_files import BEGUN, DESCRIPTION
from lightpage.systems import open_folder_to_lock
from lightpage.train.fitting.fitted import CHECKPOINTS, FITTED
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.processes import is_first_process
from lightpage.train.published.localizers import NAMES as PUBLISHED
from lightpage.train.published.training import PublishedChoices

WEIGHTS = "decoder.pt"
REFERENCES = "references.npz"
GOLDEN = "golden.npz"
FORMAT = 8
"""Version of what a run keeps while it is made: raised when features, network or checkpoints of an earlier version
would not go together with those of this one, or when the simulator's light changes (as the simulator's `LIGHT` is
then), or which pages the comparison trains on."""

_RENAMED = {"levels": "depth"}
"""Choices that runs in analysis/weights keep under other names: the depth of the network was called its levels."""


@dataclass(frozen=True)
class Run:
    """Record of a finished run, as `run.json` keeps it.

    Attributes:
        localizer: name.
        profile_toml, calibration_toml: the device.
        hyperparameters: the choices.
        camera_bit_depth: bit depth of the recording.
        trained_pages: hashes of the pages that were trained on or used to stop.
        validation_air: bits per data symbol.
        pages: recorded pages for training, for validation, and left for evaluation.
        synthetic_pages: synthetic pages trained on beside the recorded ones.
        kappa_scale: factor on p that calibrates the claimed concentration on the validation pages.
        seconds: training time, that of the recorded pages' features included, simulation not.
        provenance: command, seed, commit.
    """

    localizer: str
    profile_toml: str
    calibration_toml: str
    hyperparameters: Hyperparameters | PublishedChoices
    camera_bit_depth: int
    trained_pages: tuple[str, ...]
    validation_air: float
    kappa_scale: float
    seconds: float
    pages: tuple[int, int, int] = (0, 0, 0)
    synthetic_pages: int = 0
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def profile(self) -> Profile:
        """The nominal device."""
        return parse_profile(self.profile_toml, "profile of the run")

    @property
    def calibration(self) -> Calibration:
        """The fitted device."""
        return parse_calibration(self.calibration_toml)

    def save(self, folder: Path) -> None:
        """Write `run.json`, last of all, so that a folder with it is a finished run."""
        replace_text(
            folder / DESCRIPTION, json.dumps({"format": FORMAT, **asdict(self)}, indent=2), "description of the run"
        )


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Keep the folder of a run to this command, as long as the `with` statement lasts; it is made if missing.

    The processes that Lightning starts for further devices work in it too.

    Raises:
        InvalidInputError: another process works in it, or it cannot be made or read.
    """
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = open_folder_to_lock(folder)
    except OSError as error:
        raise InvalidInputError(f"--out {folder}", error, "a folder that can be written") from None
    try:
        try:
            if is_first_process():
                lock(descriptor, f"--out {folder}")
        except BlockingIOError:
            expected = "another --out, or to wait for its end"
            raise InvalidInputError(f"--out {folder}", "a run that another process is working on", expected) from None
        yield
    finally:
        os.close(descriptor)
        if made and not any(folder.iterdir()):
            folder.rmdir()  # refused before anything was written


def begin(folder: Path, options: dict[str, Any]) -> None:
    """Note what a run is begun with, or check that it goes on with just that.

    Args:
        folder: folder of the run, which is there.
        options: options by name, as JSON can keep them.

    Raises:
        InvalidInputError: the folder holds a run that was begun with other options.
    """
    if not check_begun(folder, options):
        replace_text(folder / BEGUN, json.dumps({"format": FORMAT, **options}, indent=2), "options of the run")


def check_begun(folder: Path, options: dict[str, Any]) -> bool:
    """Check that a run goes on with what it was begun with, so far as `options` say; returns whether it was begun.

    Raises:
        InvalidInputError: see `begin`.
    """
    try:
        kept = json.loads((folder / BEGUN).read_text("utf-8"))
        if not isinstance(kept, dict):
            raise ValueError("no table of options")
        kept = renamed(kept)
    except FileNotFoundError:
        if (folder / CHECKPOINTS).exists() or (folder / FITTED).exists():
            expected = f"a run that says in {BEGUN} what it was begun with, or another --out"
            raise InvalidInputError(f"run {folder}", "weights of unknown origin", expected) from None
        return False
    except (OSError, ValueError) as error:
        expected = "the JSON that was written when the work began, or another --out"
        raise InvalidInputError(f"run {folder}: {BEGUN}", error, expected) from None
    _check_format(folder, kept.get("format"))
    unknown = [name for name, value in options.items() if name not in kept and value is not None]
    if unknown:
        expected = "the version that began the run, or another --out"
        raise InvalidInputError(f"run {folder}", f"one that was begun without {', '.join(unknown)}", expected)
    for name, value in options.items():
        if kept.get(name) != value:
            now, then = _where_they_differ(value, kept.get(name))
            expected = f"{then!r}, with which it was begun, or another --out"
            raise InvalidInputError(f"run {folder}: {name}", now, expected)
    return True


def renamed(choices: Mapping[str, Any]) -> dict[str, Any]:
    """Choices that a run keeps, under the names that they have now."""
    return {_RENAMED.get(name, name): value for name, value in choices.items()}


def _check_format(folder: Path, found: object) -> None:
    """Refuse a run of another version, whose networks or features are others."""
    if found != FORMAT:
        expected = f"{FORMAT}, which this version makes: train anew in another folder, or take the version that made it"
        raise InvalidInputError(f"run {folder}: format", found, expected)


def _where_they_differ(now: object, then: object) -> tuple[object, object]:
    """The first lines of two texts, or entries of two tables, that differ; other values as they are."""
    if isinstance(now, str) and isinstance(then, str) and "\n" in now:
        pairs = zip_longest(now.splitlines(), then.splitlines(), fillvalue="")
        return next((pair for pair in pairs if pair[0] != pair[1]), (now, then))
    if isinstance(now, dict) and isinstance(then, dict):
        names = [*now, *(name for name in then if name not in now)]
        name = next(name for name in names if now.get(name) != then.get(name))
        inner = _where_they_differ(now.get(name), then.get(name))
        return f"{name}: {inner[0]}", f"{name}: {inner[1]}"
    return now, then


def load_run(folder: Path) -> Run:
    """Read a finished run.

    Raises:
        InvalidInputError: no such run, or one that has not finished.
    """
    path = folder / DESCRIPTION
    try:
        data = json.loads(path.read_text("utf-8"))
        found = data.pop("format", None)
        choices = data["hyperparameters"]
        if data["localizer"] in PUBLISHED:
            data["hyperparameters"] = PublishedChoices(**choices | {"channels": tuple(choices["channels"])})
        else:
            data["hyperparameters"] = Hyperparameters(**renamed(choices))
        for name in ("trained_pages", "pages"):
            data[name] = tuple(data[name])
        run = Run(**data)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InvalidInputError(f"run {folder}", error, f"a finished training run with {DESCRIPTION}") from None
    _check_format(folder, found)
    return run


def save_weights(weights: Mapping[str, Tensor], folder: Path) -> None:
    """Write the trained weights."""
    replace_file(folder / WEIGHTS, partial(torch.save, dict(weights)), "weights")


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays, compressed."""
    replace_file(path, lambda file: np.savez_compressed(file, **arrays), "arrays")  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays that `save_arrays` wrote.

    Raises:
        InvalidInputError: they are missing or damaged.
    """
    try:
        with np.load(path) as kept:
            return dict(kept)
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise InvalidInputError(f"arrays {path}", error, "the arrays of a finished run") from None


M = TypeVar("M", bound=nn.Module)


def load_decoder(folder: Path, run: Run) -> SymbolDecoder:
    """The trained decoder of a run at symbol pitch.

    Raises:
        InvalidInputError: no weights, or weights of another decoder.
    """
    choices = run.hyperparameters
    assert isinstance(choices, Hyperparameters)
    return load_weights(folder, SymbolDecoder(run.profile, run.calibration.vector, run.localizer, choices))


def load_weights(folder: Path, module: M) -> M:
    """The module with the weights of a run, in evaluation mode.

    Raises:
        InvalidInputError: no weights, or weights of another module.
    """
    try:
        module.load_state_dict(torch.load(folder / WEIGHTS, map_location="cpu", weights_only=True))
    except (OSError, RuntimeError, EOFError, UnpicklingError) as error:
        raise InvalidInputError(f"weights {folder / WEIGHTS}", error, "the weights of this run") from None
    return module.eval()
