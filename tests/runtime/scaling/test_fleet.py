"""A fleet: one device is one task, what one lacks is its own affair, and what was trained is not trained again."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from lightpage.cli.main import run as run_command
from lightpage.errors import InvalidInputError, LightpageError, RecalibrationRefusedError, StorageError
from lightpage.progress import Progress, note, track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from runtime.bundle.bundle import Bundle
from runtime.commands import bulk as command
from runtime.decoding.decoder import Decoder
from runtime.recalibration.known_pages import read_recorded
from runtime.recalibration.outcome import RecalibrationOutcome
from runtime.recalibration.recalibration import next_version, recalibrate
from runtime.scaling import job as job_module
from runtime.scaling.fine_tuning import deep_recalibration
from runtime.scaling.inline import InlineEngine
from runtime.scaling.task import FineTuning
from runtime.scaling.work import Worker
from tests.runtime import toy

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
        monkeypatch.setattr(
            command, "_engine", lambda *_: InlineEngine(Worker(1, toy.fit_references, lambda: self.deep))
        )
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


def test_a_device_of_several_recordings_is_one_task_with_one_bundle(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    status, rows = fleet.run("--pages", "5")
    assert (status, [len(rows[name]["recordings"]) for name in "ab"]) == (2, [2, 1])
    assert (rows["a"]["state"], rows["a"]["pages_used"]) == ("recalibrated", 5)  # more than one of them has
    assert (rows["b"]["state"], "at least 5 that show light" in rows["b"]["reason"]) == ("refused", True)
    assert len(list(fleet.out.glob("shards/*/*.zip"))) == 1
    assert not list(fleet.out.glob("shards/*/.*"))
    assert re.search(r"^a +recalibrated +\d\.\d{3} +4\.000 +/.*\.zip$", capsys.readouterr().out, re.MULTILINE)


def test_a_recording_that_is_lost_costs_its_device_alone(fleet: Fleet) -> None:
    whole = (fleet.folder / "a-2.h5").read_bytes()
    (fleet.folder / "a-2.h5").write_bytes(whole[:1000])
    status, rows = fleet.run()
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (75, "failed", "recalibrated")
    assert "a-2.h5" in rows["a"]["reason"]
    (fleet.folder / "a-2.h5").write_bytes(whole)
    status, rows = fleet.run()
    assert (status, rows["a"]["state"]) == (0, "recalibrated")


@pytest.mark.parametrize("left", [None, b"no zip"])
def test_a_bundle_that_is_lost_costs_its_device_alone(
    left: bytes | None, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    own = fleet.folder / "own.zip"
    own.write_bytes(whole := fleet.bundle.read_bytes())
    fleet.bundles["a"] = own
    own.unlink() if left is None else own.write_bytes(left)
    status, rows = fleet.run()
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (75, "failed", "recalibrated")
    assert str(own) in rows["a"]["reason"]
    assert f"device a: bundle {own}" in capsys.readouterr().err
    assert fleet.run()[0] == 75  # it is no other question
    own.write_bytes(whole)
    status, rows = fleet.run()
    assert (status, rows["a"]["state"]) == (0, "recalibrated")
    own.unlink()
    status, rows = fleet.run()
    assert (status, rows["a"]["state"]) == (0, "recalibrated")


def test_a_bundle_with_another_name_is_taken_once_the_fleet_says_so(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet.bundles["a"] = fleet.folder / "mistyped.zip"
    status, rows = fleet.run()
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (75, "failed", "recalibrated")
    assert "mistyped.zip" in capsys.readouterr().err
    right = fleet.folder / "right.zip"
    right.write_bytes(fleet.bundle.read_bytes())
    fleet.bundles["a"] = right
    status, rows = fleet.run()
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (0, "recalibrated", "recalibrated")


def test_a_bundle_may_be_moved_before_its_device_is_done(fleet: Fleet) -> None:
    whole = (fleet.folder / "b.h5").read_bytes()
    (fleet.folder / "b.h5").write_bytes(b"no recording")
    before = fleet.folder / "before.zip"
    before.write_bytes(fleet.bundle.read_bytes())
    fleet.bundles = dict.fromkeys(fleet.bundles, before)
    assert fleet.run()[0] == 75
    (fleet.folder / "b.h5").write_bytes(whole)
    fleet.bundles = dict.fromkeys(fleet.bundles, before.rename(fleet.folder / "after.zip"))
    status, rows = fleet.run()
    assert (status, rows["b"]["state"]) == (0, "recalibrated")


def test_a_pattern_that_names_no_file_costs_its_device_alone(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    (fleet.folder / "b.h5").rename(fleet.folder / "elsewhere.h5")
    fleet.patterns["b"] = "b*.h5"
    status, rows = fleet.run()
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (75, "recalibrated", "failed")
    told = f"device b: recording {fleet.folder / 'b*.h5'}: got no file when the run began"
    assert told in capsys.readouterr().err
    (fleet.folder / "elsewhere.h5").rename(fleet.folder / "b.h5")
    assert fleet.run()[0] == 75
    assert told in capsys.readouterr().err


def test_recordings_of_a_finished_device_may_go(fleet: Fleet) -> None:
    assert fleet.run()[0] == 0
    for name in ("a-1", "a-2"):
        (fleet.folder / f"{name}.h5").unlink()
    status, rows = fleet.run()
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (0, "recalibrated", "recalibrated")


def test_bundles_that_are_as_they_were_are_not_read_again(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fleet.run()[0] == 0
    monkeypatch.setattr(job_module, "bundle_sha256", lambda path: pytest.fail(f"{path} is read"))
    assert fleet.run()[0] == 0


def test_frames_that_could_not_be_read_say_nothing_of_the_device(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(recording: Recording, page: int) -> FramePair:
        raise StorageError(f"recording {recording.path}", "Input/output error", "data that can be read")

    with monkeypatch.context() as patch:
        patch.setattr(Recording, "frames", broken)
        status, rows = fleet.run()
        assert (status, {row["state"] for row in rows.values()}) == (75, {"failed"})
    assert "Input/output error" in capsys.readouterr().err
    status, rows = fleet.run()
    assert (status, {row["state"] for row in rows.values()}) == (0, {"recalibrated"})


def test_finished_devices_are_counted_where_nothing_can_train(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fleet.run("--deep")[0] == 0

    def missing() -> Deep:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(command, "deep_recalibration", missing)
    status, rows = fleet.run("--deep")
    assert (status, {row["state"] for row in rows.values()}) == (0, {"recalibrated"})


@pytest.mark.parametrize("form", [(), ("--deep",)])
def test_a_part_has_whole_devices_and_tells_of_no_others(
    form: tuple[str, ...], fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    for part, name, recordings in (("1/2", "b", 1), ("0/2", "a", 2)):
        status, rows = fleet.run(*form, "--part", part, "--metrics-file", str(fleet.folder / "bulk.prom"))
        assert (status, list(rows), rows[name]["state"]) == (0, [name], "recalibrated")
        assert len(rows[name]["recordings"]) == recordings
        assert f'lightpage_bulk_job_pages{{part="{part}",run="out"}} 1.0' in (fleet.folder / "bulk.prom").read_text()
    assert re.search(r"^devices +1$", capsys.readouterr().out, re.MULTILINE)
    status, rows = fleet.run(*form)
    assert (status, sorted(rows)) == (0, ["a", "b"])
    assert not capsys.readouterr().err
    assert [path.parent.name for path in sorted(fleet.out.glob("shards/*/*.zip"))] == ["000000", "000002"]


def test_frames_of_all_recordings_of_a_device_are_counted_as_read(fleet: Fleet) -> None:
    fleet.run("--deep")
    stored = []
    for name in ("a-1", "a-2"):
        with Recording.open(fleet.folder / f"{name}.h5") as recording:
            stored.append(recording.stored_page_bytes * PAGES)
    assert json.loads((fleet.out / "shards/000000/00000000.json").read_text())["read_bytes"] == sum(stored)


def test_a_device_that_is_done_stays_so_when_its_run_has_gone(fleet: Fleet) -> None:
    def gone(bundle: Path, run: Path | None, pages: int) -> None:
        raise InvalidInputError("run", "none", "a run")

    assert fleet.run("--deep")[0] == 0
    fleet.deep.check = gone  # type: ignore[method-assign]
    status, rows = fleet.run("--deep")
    assert (status, {row["state"] for row in rows.values()}) == (0, {"recalibrated"})


def test_a_device_of_two_unreadable_recordings_has_failed_once(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a-1", "a-2"):
        (fleet.folder / f"{name}.h5").write_bytes(b"no recording")
    assert fleet.run()[0] == 75
    assert "0 of 2 devices refused and 1 failed" in capsys.readouterr().err


def test_the_deep_form_is_given_all_pages_and_the_run_of_each_device(fleet: Fleet) -> None:
    status, rows = fleet.run("--deep", "--steps", "20", "--seed", "7")
    tuning = FineTuning(steps=20, seed=7)
    assert fleet.deep.asked == [("run-a", 2 * PAGES, 2 * PAGES, tuning, []), ("run-b", PAGES, PAGES, tuning, [])]
    assert (status, {row["state"] for row in rows.values()}) == (0, {"recalibrated"})
    assert Bundle.open(rows["a"]["bundle"]).version == "toy-1+r1"
    log = (fleet.out / "shards/000000/00000000.log").read_text()
    assert [line.partition(" ")[2] for line in log.splitlines()][:5] == [
        "fit: 0%",
        "so far",
        "training: step 1 of 2",
        "so far",
        "training: 2 steps",
    ]


def test_a_device_without_its_run_is_told_before_anything_is_done(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    status, rows = fleet.run("--deep", runs=("b",))
    assert (status, rows["a"]["state"], rows["b"]["state"]) == (75, "failed", "recalibrated")
    assert rows["a"]["reason"] == "run: got none, wanted a run"
    assert "device a: run: got none" in capsys.readouterr().err.partition("device b")[0]
    assert [asked[0] for asked in fleet.deep.asked] == ["run-b"]


def test_an_interrupted_fleet_goes_on_in_the_same_folder(fleet: Fleet) -> None:
    fleet.deep.error = KeyboardInterrupt()
    assert fleet.run("--deep")[0] == 130
    fleet.deep.error = None
    assert fleet.run("--deep")[0] == 0
    assert [(run, there) for run, *_, there in fleet.deep.asked] == [("run-a", []), ("run-a", ["begun"]), ("run-b", [])]
    assert fleet.run("--deep")[0] == 0
    assert len(fleet.deep.asked) == 3


@pytest.mark.parametrize(
    ("error", "state", "again", "ends"),
    [
        (RecalibrationRefusedError("fine-tuned model", "less", "more"), "refused", 2, 2),
        (InvalidInputError("run", "another", "this one"), "failed", 4, 75),
    ],
)
def test_what_a_device_is_refused_for_stays_and_all_else_is_tried_again(
    error: LightpageError, state: str, again: int, ends: int, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet.deep.error = error
    for _ in range(2):
        status, rows = fleet.run("--deep")
        assert (status, [row["state"] for row in rows.values()]) == (ends, [state, state])
        assert rows["a"]["reason"] == str(error)
        assert f"device a: {error.subject}" in capsys.readouterr().err.replace(f"recording {fleet.folder}/a-1.h5: ", "")
    assert len(fleet.deep.asked) == again


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--steps", "20"), "--steps: got without --deep"),
        (("--deep", "--recordings", "b.h5"), "--deep: got with --recordings"),
    ],
)
def test_options_that_do_nothing_are_refused(
    options: tuple[str, ...], told: str, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fleet.run(*options)[0] == 2
    assert told in capsys.readouterr().err


def test_another_run_or_training_in_the_same_folder_is_refused(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fleet.run("--deep")[0] == 0
    for options, runs, told in (
        (("--deep", "--steps", "20"), ("a", "b"), "fine_tuning: got steps=20"),
        (("--deep",), ("a",), "run of b: got None"),
    ):
        assert fleet.run(*options, runs=runs)[0] == 2
        assert told in capsys.readouterr().err


def test_without_the_other_package_there_is_no_deep_form() -> None:
    with pytest.raises(LightpageError, match="no entry point deep"):
        deep_recalibration([])
