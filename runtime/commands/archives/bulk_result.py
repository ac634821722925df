"""The result of `lightpage bulk`: figures for programs, a table for people, and the error that it ends with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightpage.codec.volume_file import ranges
from lightpage.errors import InvalidInputError, LightpageError, LostDataError, MissingResultsError
from lightpage.progress import warn
from lightpage.runtime.archives.run.driver import Progressed
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import WHOLE, Part
from lightpage.runtime.archives.run.task import Operation
from lightpage.runtime.archives.run.totals import AIR, DeviceState, Totals
from lightpage.runtime.archives.run.volumes import RecoveredFile


@dataclass(frozen=True)
class Result:
    """The question, the work and the findings of a run.

    Attributes:
        job: what was asked.
        part: what this process does of it.
        made: what it has done now.
        found: what there is of the part.
        files: files of a recovery of the whole.
    """

    job: Job
    part: Part
    made: Progressed
    found: Totals
    files: list[RecoveredFile]

    def to_json(self) -> dict[str, Any]:
        """All that is known, under the names that other programs read."""
        job, made = self.job, self.made
        return {
            "operation": str(job.choices.operation),
            "part": None if self.part == WHOLE else str(self.part),
            "bundles": [bundle.model_dump(mode="json") for bundle in job.bundles],
            "this_run": {
                **{name: getattr(made, name) for name in ("pages", "ranges", "failed", "given_up", "seconds")},
                "problems": [str(problem) for problem in made.problems],
                "pages_per_s": made.pages_per_s,
                "worker_restarts": made.restarts,
            },
            **self.found.to_json(),
            **({"files": [file.to_json() for file in self.files]} if self._recovers else {}),
        }

    def table(self) -> str:
        """The figures for people."""
        made, found, part = self.made, self.found, self.part
        air = found.figures[AIR].value
        recalibrated = self._recalibrates
        unit = "devices" if recalibrated else "pages"
        speed = "" if made.pages_per_s is None else f" in {made.seconds:.1f} s, {made.pages_per_s:.2f} a second"
        causes = ", ".join(f"{count} {cause}" for cause, count in found.lost.most_common())
        rows = [
            ("part", "" if part == WHOLE else f"{part}; without --part, the same command says it of all parts"),
            (unit, f"{len(found.devices)}" if recalibrated else f"{found.pages} of {len(found.recordings)} recordings"),
            ("this run", f"{made.pages} {unit}{speed}" if made.pages or made.failed else "nothing was missing"),
            ("recalibrated" if recalibrated else "read", f"{found.read}"),
            ("healed", f"{found.healed} of them" if found.healed else ""),
            ("left out", f"{found.left_out} that a bundle was made from" if found.left_out else ""),
            ("refused" if recalibrated else "lost", f"{found.lost.total()} ({causes})" if causes else "0"),
            ("missing", f"{found.missing}, the next run tries them again" if found.missing else ""),
            ("models", ", ".join(f"{version}: {count}" for version, count in found.models.items())),
            ("device has changed", f"by {found.recalibration_due} pages" if found.recalibration_due else ""),
            ("AIR", "" if air is None else f"{air:.3f} bit/symbol"),
            ("workers that died", f"{made.restarts}" if made.restarts else ""),
        ]
        for each in found.rounds:
            gain = ""
            if each.air_before.value is not None and each.air_after.value is not None:
                gain = f"; AIR of them {each.air_before.value:.3f} before, {each.air_after.value:.3f} now"
            counts = f"{each.pages_won} won, {each.pages_better} better, {each.pages_lost_still} lost still"
            rows.append((f"again, {each.model.version}", f"{each.pages} pages: {counts}{gain}"))
        rows += [(f"volume {f.volume.id}", f.error or f"{f.path}, {f.volume.file_bytes} bytes") for f in self.files]
        told = "\n".join(f"{name:<20} {value}" for name, value in rows if value)
        return f"{told}\n\n{_device_table(found.devices)}" if found.devices else told

    def failure(self, subject: str) -> LightpageError | None:
        """The error that a run ends with where something is missing or lost; None where nothing is.

        Args:
            subject: the run, for people.
        """
        made, found, files = self.made, self.found, self.files
        lost, told = found.lost.total(), [*map(str, made.problems), *found.told]
        if (more := made.failed + lost - len(told)) > 0:
            told.append(f"and {more} more")
        got, expected = f"{lost} of {found.pages} lost and {found.missing} missing", "pages that can be read"
        if made.given_up:
            got += f", {made.given_up} recordings given up"
        if made.failed:
            got += f", {made.failed} ranges or recordings without a result"
        if self._recalibrates:
            failed = sum(row["state"] is DeviceState.FAILED for row in found.devices)
            got = f"{lost} of {len(found.devices)} devices refused and {failed} failed"
            expected = "known pages of each device, and all that it needs"
        got = f"{got} ({'; '.join(told)})"
        if made.failed:
            return MissingResultsError(subject, got, f"{expected}; the same command tries again what is missing")
        if not self._recovers:
            return InvalidInputError(subject, got, expected) if lost or made.given_up else None
        if unwritten := [file for file in files if file.passes]:
            got = f"no file of volumes {ranges([file.volume.id for file in unwritten])} ({unwritten[0].error})"
            return MissingResultsError(subject, got, "room and storage for them; the same command tries again")
        broken = ranges([file.volume.id for file in files if file.error is not None])
        if broken or ((lost or made.given_up) and not files and self.part == WHOLE):
            what = f"volumes {broken} without a file" if broken else "no file"
            return LostDataError(subject, f"{what}; {got}", "pages that suffice for every file")
        if lost or made.given_up:
            whole = self.part == WHOLE
            then = "every file is whole all the same" if whole else "the files come when all parts are done"
            warn(f"{subject}: {got}; {then}")
        return None

    @property
    def _recalibrates(self) -> bool:
        return self.job.choices.operation is Operation.RECALIBRATE

    @property
    def _recovers(self) -> bool:
        return self.job.choices.operation is Operation.RECOVER


def _device_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what became of each device, for people."""

    def air(value: float | None) -> str:
        return "" if value is None else f"{value:.3f}"

    cells = [("device", "state", "AIR before", "after", "bundle, or why there is none")]
    for row in rows:
        name = row["device"] or Path(row["recordings"][0]).name
        before, after = (air(row.get(f"air_{when}")) for when in ("before", "after"))
        cells.append((name, str(row["state"]), before, after, row.get("bundle") or row["reason"]))
    widths = [max(len(cell[column]) for cell in cells) for column in range(2)]
    return "\n".join(
        f"{name:<{widths[0]}}  {state:<{widths[1]}}  {before:>10}  {after:>6}  {told}".rstrip()
        for name, state, before, after, told in cells
    )
