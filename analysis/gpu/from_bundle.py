"""The product around a decoder for many pages: its bundle, the service, `lightpage bulk`, and the page code."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.codec.speed import PAGES, time_page
from analysis.comparison.data_set import LEVELS, data_set_of
from analysis.gpu.kept_form import Scene, kept_decoder
from analysis.scaling.bulk_run import records_of
from lightpage.device.profile import load_profile
from lightpage.export.from_run import export_run
from lightpage.page.levels import Levels
from lightpage.page.symbols import pilot_mask
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.archives.run.shard import ShardRecord
from lightpage.runtime.model.execution.providers import Provider
from lightpage.train.models.presets import PRESETS
from lightpage.train.runs import GOLDEN, REFERENCES, Run, save_arrays, save_weights

PRESET = "standard"
_RANGE, _RANGES = 32, 3
"""Ranges of the recording; the first, behind which bulk is warm, does not count."""
_CODE_ROUNDS = 3


def page_codes() -> dict[str, Any]:
    """Time of a page from posterior to checked bytes on one core, by kind of page."""
    return {
        name: time_page(load_profile(profile).with_symbols_of(size), code, Levels(code.levels), _CODE_ROUNDS)
        for name, (profile, size, code) in PAGES.items()
    }


@dataclass(frozen=True)
class Served:
    """A kept decoder as a bundle, and pages of its device as a recording, to be read by the product.

    Attributes:
        folder, scene: folder and scene of the data set.
        reflections: rounds to the field.
        provider: provider that computes pages.
        largest: pages of a batch at most.
        out: folder for both.
    """

    folder: Path
    scene: Scene
    reflections: int
    provider: Provider
    largest: int
    out: Path

    def bundle(self) -> dict[str, Any]:
        """Make both; returns the bundle's size in bytes."""
        scene, path = self.scene, self._bundle
        path.unlink(missing_ok=True)
        decoder = kept_decoder(self.folder, PRESET, scene, self.reflections)
        _, device, seed = data_set_of(self.folder)
        bits = device.sensor.bit_depth
        run = Run(
            localizer=PRESETS[PRESET].localizer,
            profile_toml=scene.profile.to_toml(),
            calibration_toml=scene.calibration.to_toml(),
            hyperparameters=decoder.choices,
            camera_bit_depth=bits,
            trained_pages=(),
            validation_air=0.0,
            kappa_scale=1.0,
            seconds=0.0,
            provenance={"command": f"python -m analysis.gpu.bench --kept {self.folder.name}", "seed": seed},
        )
        golden, references = vars(scene.pairs[0]), vars(scene.references)
        with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
            save_weights(decoder.state_dict(), Path(name))
            save_arrays(Path(name) / REFERENCES, {**references, "pilots": pilot_mask(scene.profile)})
            save_arrays(Path(name) / GOLDEN, golden)
            run.save(Path(name))
            export_run(Path(name), path, name=self.folder.name, version="kept", batches=True)
        with RecordingWriter(self._recording, scene.profile, LEVELS, bits, scene.references) as writer:
            for page in range(_RANGE * _RANGES):
                writer.append(scene.symbols[page % len(scene.pairs)], scene.pairs[page % len(scene.pairs)])
        return {"bytes": path.stat().st_size}

    def through_service(self, left_s: float) -> dict[str, Any]:
        """Figures of `analysis.gpu.through_service`, which ends after `left_s` at the latest."""
        figures = self.out / "service.json"
        self._run(
            ["analysis.gpu.through_service", *self._asked, "--recording", self._recording, "--json", figures], left_s
        )
        found: dict[str, Any] = json.loads(figures.read_text())
        return found

    def bulk(self, left_s: float) -> dict[str, Any]:
        """Pages a second of one worker of `lightpage bulk decode` once it is warm."""
        folder = self.out / "bulk"
        shutil.rmtree(folder, ignore_errors=True)
        asked = ["lightpage", "bulk", "decode", folder, *self._asked, "--recordings", self._recording]
        self._run([*asked, "--workers", "1", "--range-pages", str(_RANGE)], left_s)
        records = [ShardRecord.read(path.with_suffix("")) for path in records_of(folder)]
        warm = sorted(records, key=lambda record: record.finished_s)[1:]
        shutil.rmtree(folder)
        return {"pages_per_s": sum(len(each.pages) for each in warm) / sum(each.seconds for each in warm)}

    @property
    def _bundle(self) -> Path:
        return self.out / "bundle.zip"

    @property
    def _recording(self) -> Path:
        return self.out / "recording.h5"

    @property
    def _asked(self) -> list[str | Path]:
        return ["--bundle", self._bundle, "--provider", str(self.provider), "--batches", str(self.largest)]

    @staticmethod
    def _run(module: Sequence[str | Path], left_s: float) -> None:
        subprocess.run([sys.executable, "-m", *module], check=True, timeout=left_s, stdout=subprocess.DEVNULL)
