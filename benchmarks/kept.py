"""Calibrations and trained arms that need not be made again: some take hours, and they are small."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import torch

from optics.files import replace_file, write_json
from train.fitting import CHECKPOINTS, FITTED, FITTED_WEIGHTS
from train.run import BEGUN

TRAINED = Path(__file__).parent / "trained"
CALIBRATION = "calibration.toml"
MADE_BY = "made_by.json"
"""Beside an arm's weights: command, seed and commit that made them."""
_LARGE = 1000
"""Numbers of a tensor from which it is kept in half precision."""


def bring(light: Path, kept: Path) -> list[str]:
    """Copy what was calibrated and trained on a light to where it would be made again; what is there stays.

    Args:
        light: folder of the light, with its recording.
        kept: folder of the same light, as `keep` left it; nothing is taken if it was another one.

    Returns:
        The runs that were copied, below `light`.
    """
    if _read(kept / BEGUN) != _read(light / BEGUN):
        return []
    if (kept / CALIBRATION).exists() and not (light / CALIBRATION).exists():
        shutil.copyfile(kept / CALIBRATION, light / CALIBRATION)
    brought = []
    for described in sorted(kept.rglob(FITTED)):
        run = described.parent.relative_to(kept)
        if (light / run / FITTED).exists() or (light / run / CHECKPOINTS).exists():
            continue
        (light / run).mkdir(parents=True, exist_ok=True)
        for name in (BEGUN, FITTED_WEIGHTS, FITTED):
            if (kept / run / name).exists():
                shutil.copyfile(kept / run / name, light / run / name)
        brought.append(str(run))
    return brought


def keep(light: Path, kept: Path, provenance: dict[str, Any]) -> None:
    """Copy calibration and trained arms of a light, large tensors in half precision; what is kept already stays.

    Args:
        light: folder of the light, with its recording.
        kept: folder that `bring` takes it from, made if missing.
        provenance: of what is trained.
    """
    kept.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(light / BEGUN, kept / BEGUN)
    if not (kept / CALIBRATION).exists():
        shutil.copyfile(light / CALIBRATION, kept / CALIBRATION)
    for described in sorted(light.rglob(FITTED)):
        run = described.parent.relative_to(light)
        if (kept / run / FITTED).exists():
            continue
        (kept / run).mkdir(parents=True, exist_ok=True)
        if (light / run / BEGUN).exists():
            shutil.copyfile(light / run / BEGUN, kept / run / BEGUN)
        weights = torch.load(light / run / FITTED_WEIGHTS, map_location="cpu", weights_only=True)
        halved = {name: value.half() if _is_large(value) else value for name, value in weights.items()}
        replace_file(kept / run / FITTED_WEIGHTS, partial(torch.save, halved), "weights")
        write_json(kept / run / MADE_BY, provenance)
        shutil.copyfile(described, kept / run / FITTED)


def _is_large(value: torch.Tensor) -> bool:
    return value.is_floating_point() and value.numel() >= _LARGE


def _read(path: Path) -> Any:
    return json.loads(path.read_text()) if path.exists() else None
