"""What goes into a recalibration in a process of its own, and what comes out: files of one private folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter

from lightpage.errors import ERRORS, LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle, write_bundle
from lightpage.runtime.model.decoding.tracking import TrackerMemory
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.outcome import RecalibrationOutcome

_BUNDLE, _PAGES, _JOB, _RESULT = "bundle.zip", "pages.npz", "job.json", "result.json"

_OUTCOME = TypeAdapter(RecalibrationOutcome)


class Job(BaseModel):
    """What a recalibration shall do, beside its bundle and its pages.

    Attributes:
        bundle: where the bundle came from, for messages.
        out: path of the new bundle.
        version: of the new bundle.
        threads: of one inference.
        memory: of the service's tracker; None where it follows nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    bundle: Path
    out: Path
    version: str
    threads: int
    memory: TrackerMemory | None


@dataclass(frozen=True)
class WorkFolder:
    """A private folder that one recalibration is handed over in.

    Attributes:
        path: that exists, and belongs to nobody else.
    """

    path: Path

    def write_task(self, bundle: Bundle, pages: KnownPages, job: Job) -> None:
        """Write all that the worker needs. The bundle is written as it lies in memory: its file may have changed.

        Raises:
            BundleError, OSError: the folder cannot be written.
        """
        write_bundle(self.path / _BUNDLE, bundle.manifest, bundle.files)
        arrays: dict[str, Any] = {
            "in_phase": np.stack([pair.in_phase for pair in pages.pairs]),
            "quadrature": np.stack([pair.quadrature for pair in pages.pairs]),
            "symbols": np.stack(pages.symbols),
            "levels": pages.levels,
            "image_px": pages.image_px,
        }
        if pages.references is not None:
            arrays["reference_in_phase"] = pages.references.in_phase
            arrays["reference_quadrature"] = pages.references.quadrature
        if pages.pilot_mask is not None:
            arrays["pilot_mask"] = pages.pilot_mask
        np.savez(self.path / _PAGES, **arrays)
        (self.path / _JOB).write_text(job.model_dump_json())

    def read_task(self) -> tuple[Bundle, KnownPages, Job]:
        """What the worker needs.

        Raises:
            BundleError, OSError, ValueError: the folder is none that `write_task` has filled.
        """
        job = Job.model_validate_json((self.path / _JOB).read_bytes())
        bundle = replace(Bundle.open(self.path / _BUNDLE), path=job.bundle)
        with np.load(self.path / _PAGES, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        frames = zip(arrays["in_phase"], arrays["quadrature"], strict=True)
        references = None
        if "reference_in_phase" in arrays:
            references = FramePair(arrays["reference_in_phase"], arrays["reference_quadrature"])
        x, y = map(float, arrays["image_px"])
        pairs, symbols, levels = tuple(FramePair(*pair) for pair in frames), tuple(arrays["symbols"]), arrays["levels"]
        return bundle, KnownPages(pairs, symbols, int(levels), references, arrays.get("pilot_mask"), (x, y)), job

    def write_outcome(self, outcome: RecalibrationOutcome) -> None:
        """Write what the recalibration found."""
        self._write_result({"outcome": _OUTCOME.dump_python(outcome, mode="json")})

    def write_error(self, error: LightpageError) -> None:
        """Write why there is no outcome."""
        told = {"kind": type(error).__name__, **{name: vars(error)[name] for name in ("subject", "got", "expected")}}
        self._write_result({"error": told})

    def _write_result(self, result: dict[str, Any]) -> None:
        made = self.path / f"{_RESULT}.made"
        made.write_text(json.dumps(result))
        made.rename(self.path / _RESULT)

    def read_result(self) -> RecalibrationOutcome | None:
        """What the recalibration found; None where it came to no end.

        Raises:
            LightpageError: of the class and with the words that the worker met.
        """
        try:
            result = json.loads((self.path / _RESULT).read_bytes())
        except FileNotFoundError:
            return None
        if (told := result.get("error")) is not None:
            raise ERRORS[told["kind"]](told["subject"], told["got"], told["expected"])
        return _OUTCOME.validate_python(result["outcome"])


def told_step(name: str, fraction: float) -> str:
    """A step as a line for the parent."""
    return json.dumps({"step": name, "fraction": fraction})


def heard_step(line: bytes) -> tuple[str, float] | None:
    """The step that a line tells; None where it is something else that was printed."""
    try:
        told = json.loads(line)
        return str(told["step"]), float(told["fraction"])
    except (ValueError, TypeError, KeyError):
        return None
