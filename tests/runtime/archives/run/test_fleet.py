"""A fleet: one device is one task, what one lacks is its own affair, and what was trained is not trained again."""

import json
import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import pytest

from lightpage.cli.main import run as run_command
from lightpage.errors import InvalidInputError, LightpageError, RecalibrationRefusedError
from lightpage.progress import Progress, note, track
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.run.task import FineTuning
from lightpage.runtime.archives.workers.fine_tuning import deep_recalibration
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.commands.archives import bulk as command
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.known_pages import read_recorded
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, next_version, recalibrate
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.archives.archive import InlineEngine

PAGES = 3


@dataclass
class Deep:
    """A deep recalibration that fits as the toy does, and keeps what it was asked."""

    error: Exception | None = None
    asked: list[tuple[str, int, int, FineTuning, list[str]]] = field(default_factory=list)

    def check(self, bundle: Path, run: Path | None, pages: int) -> None:
        if run is None:
            raise InvalidInputError("run", "none", "a run")

    def recalibrate(
        self,
        decoder: Decoder,
        recording: Recording,
        run: Path,
        folder: Path,
        out: Path,
        choices: FineTuning,
        pages: int,
        progress: Progress,
    ) -> RecalibrationOutcome:
        folder.mkdir(exist_ok=True)
        self.asked.append((run.name, recording.pages, pages, choices, [path.name for path in folder.iterdir()]))
        (folder / "begun").touch()
        progress("fit", 0.0)
        for _ in track(range(2), "training", unit="step", total=2):
            note("so far")
        if self.error is not None:
            raise self.error
        version = next_version(decoder.version)
        return recalibrate(decoder, read_recorded(recording, range(2)), out, version, toy.fit_references, progress)


class Fleet:
    """Devices `a` and `b` of toy recordings, and `lightpage bulk recalibrate` on them within this process."""

    def __init__(self, folder: Path, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.out, self.deep = folder, folder / "out", Deep()
        self.bundle, self.bundles = bundle, {"a": bundle, "b": bundle}
        self.patterns = {"a": "a-*.h5", "b": "b.h5"}
        for number, name in enumerate(("a-1", "a-2", "b")):
            device = toy.ToyDevice((148.0, 90.0), seed=number)
            toy.write_toy_recording(folder / f"{name}.h5", device, 16, PAGES, number)
        worker = Worker(1, toy.fit_references, lambda: self.deep)
        monkeypatch.setattr(command, "engine_of", lambda *_: InlineEngine(worker))
        monkeypatch.setattr(command, "CLOCK", HandClock())
        monkeypatch.setattr(command, "deep_recalibration", lambda: self.deep)

    def run(self, *options: str, runs: tuple[str, ...] = ("a", "b")) -> tuple[int, dict[str, dict[str, Any]]]:
        """Exit status, and a row for each device."""
        tables = []
        for name, pattern in self.patterns.items():
            named = [f'name = "{name}"', f'bundle = "{self.bundles[name]}"', f'recordings = ["{pattern}"]']
            tables += ["[[device]]", *named, *([f'run = "run-{name}"'] if name in runs else [])]
        (self.folder / "fleet.toml").write_text("\n".join(tables))
        told = self.folder / "told.json"
        told.unlink(missing_ok=True)
        words = ["recalibrate", str(self.out), "--fleet", str(self.folder / "fleet.toml"), "--json", str(told)]
        status = run_command(command.bulk, [*words, *options])
        return status, {row["device"]: row for row in json.loads(told.read_text())["devices"]} if told.exists() else {}


@pytest.fixture
def fleet(tmp_path: Path, toy_zip: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    return Fleet(tmp_path, toy_zip, monkeypatch)


def states(rows: dict[str, dict[str, Any]]) -> dict[str, str]:
    return {name: row["state"] for name, row in rows.items()}


DONE = {"a": "recalibrated", "b": "recalibrated"}
A_FAILED = {"a": "failed", "b": "recalibrated"}


def test_a_device_of_several_recordings_is_one_task_and_another_whose_pages_contradict_it_is_refused_by_name(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(fleet.folder / "b.h5", "r+") as file:
        file["symbols"][:] = toy.symbols_of(16, 999, PAGES)
    status, rows = fleet.run("--pages", "5", "--part", "1/2")
    assert (status, list(rows), len(rows["b"]["recordings"])) == (2, ["b"], 1)
    shutil.rmtree(fleet.out)
    status, rows = fleet.run("--pages", "5")
    assert (status, states(rows)) == (2, {"a": "recalibrated", "b": "refused"})
    assert ([len(rows[name]["recordings"]) for name in "ab"], rows["a"]["pages_used"]) == ([2, 1], 5)
    assert rows["a"]["air_after"] > rows["a"]["air_before"]
    made = Bundle.open(rows["a"]["bundle"])
    assert (made.version, made.table["reference_in_phase"].mean()) == ("toy-1+r1", pytest.approx(148))
    assert not list(fleet.out.glob("shards/*/.*"))
    told = capsys.readouterr()
    assert f"device b: recording {fleet.folder / 'b.h5'}: " in told.err
    assert re.search(r"^a +recalibrated +\d\.\d{3} +4\.000 +/.*\.zip$", told.out, re.MULTILINE)
    assert re.search(r"^this run +2 devices", told.out, re.MULTILINE)
    assert fleet.run("--pages", "5")[0] == 2  # it stays so
    assert re.search(r"^this run +nothing", capsys.readouterr().out, re.MULTILINE)


def test_what_a_device_lacks_costs_that_device_alone_until_it_is_there(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    own, recording = fleet.folder / "own.zip", fleet.folder / "a-2.h5"
    kept = {own: fleet.bundle.read_bytes(), recording: recording.read_bytes()}
    fleet.bundles["a"] = own
    recording.write_bytes(b"no recording")
    for content, lacking in ((None, own), (b"no zip", own), (kept[own], recording)):
        own.unlink(missing_ok=True) if content is None else own.write_bytes(content)
        status, rows = fleet.run()
        assert (status, states(rows), str(lacking) in rows["a"]["reason"]) == (75, A_FAILED, True)
    assert f"device a: bundle {own}" in capsys.readouterr().err
    recording.write_bytes(kept[recording])
    fleet.bundles["a"] = own.rename(fleet.folder / "moved.zip")
    status, rows = fleet.run()
    assert (status, states(rows)) == (0, DONE)
    for path in (fleet.bundles["a"], recording):  # of a finished device they may go
        path.unlink()
    status, rows = fleet.run()
    assert (status, states(rows)) == (0, DONE)


def test_the_deep_form_is_given_all_pages_and_the_run_of_each_device(fleet: Fleet) -> None:
    status, rows = fleet.run("--deep", "--steps", "20", "--seed", "7", runs=("b",))
    assert (status, states(rows), rows["a"]["reason"]) == (75, A_FAILED, "run: got none, wanted a run")
    assert [asked[0] for asked in fleet.deep.asked] == ["run-b"]
    shutil.rmtree(fleet.out)
    fleet.deep.asked.clear()
    status, rows = fleet.run("--deep", "--steps", "20", "--seed", "7")
    tuning = FineTuning(steps=20, seed=7)
    assert fleet.deep.asked == [("run-a", 2 * PAGES, 2 * PAGES, tuning, []), ("run-b", PAGES, PAGES, tuning, [])]
    assert (status, states(rows)) == (0, DONE)
    assert Bundle.open(rows["a"]["bundle"]).version == "toy-1+r1"
    log = (fleet.out / "shards/000000/00000000.log").read_text()
    told = [line.partition(" ")[2] for line in log.splitlines()][:5]
    assert told == ["fit: 0%", "so far", "training: step 1 of 2", "so far", "training: 2 steps"]


@pytest.mark.parametrize(
    ("error", "state", "again", "ends"),
    [
        (RecalibrationRefusedError("fine-tuned model", "less", "more"), "refused", 2, 2),
        (InvalidInputError("run", "another", "this one"), "failed", 4, 75),
    ],
)
def test_what_a_device_is_refused_for_stays_and_all_else_is_tried_again(
    error: LightpageError, state: str, again: int, ends: int, fleet: Fleet
) -> None:
    fleet.deep.error = error
    for _ in range(2):
        status, rows = fleet.run("--deep")
        assert (status, states(rows)) == (ends, dict.fromkeys("ab", state))
        assert rows["a"]["reason"] == str(error)
    assert len(fleet.deep.asked) == again


def test_without_the_other_package_there_is_no_deep_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightpage.runtime.archives.workers.fine_tuning.entry_points", lambda **_: [])
    with pytest.raises(LightpageError, match="entry point"):
        deep_recalibration()
