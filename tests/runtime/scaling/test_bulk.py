"""`lightpage bulk`: every page once, whatever happens in between, and what is done is not done again."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest

from lightpage.cli.main import run as run_command
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.recording.reader import Recording
from runtime.bulk.evaluation import evaluate
from runtime.bundle.bundle import Bundle
from runtime.commands import bulk as command
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from runtime.scaling import ledger as ledger_module
from runtime.scaling.engine import Engine
from runtime.scaling.inline import InlineEngine
from runtime.scaling.job import found_recordings
from runtime.scaling.ledger import Ledger
from runtime.scaling.part import Part
from runtime.scaling.shard import ShardRecord
from runtime.scaling.task import Task
from runtime.scaling.work import Worker
from tests.runtime import coded, toy

ROOT = Path(__file__).resolve().parents[3]
PAGES, RANGE = 7, 3


class Archive:
    """Two toy recordings, and `lightpage bulk` on them within this process."""

    def __init__(self, folder: Path, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.out, self.json = folder, folder / "out", folder / "J.json"
        self.tasks: list[Task] = []
        self.before_each: Callable[[Task], None] = lambda task: None
        monkeypatch.setattr(command, "_engine", lambda *_: self.engine())
        self.bundle = Path(shutil.copy(bundle, folder / "toy.zip"))
        for name, seed in (("a", 1), ("b", 2)):
            toy.write_toy_recording(folder / f"{name}.h5", toy.ToyDevice(seed=seed), 16, PAGES, seed)

    def engine(self) -> Engine:
        archive = self

        class Watched(Worker):
            def work(self, task: Task) -> Any:
                archive.before_each(task)
                archive.tasks.append(task)
                return super().work(task)

        return InlineEngine(Watched(1, toy.fit_references))

    def run(self, operation: str, *options: str, asked: bool = True) -> tuple[int, dict[str, Any]]:
        """Exit status and figures; `tasks` has what was done."""
        self.tasks = []
        self.json.unlink(missing_ok=True)
        words = [operation, str(self.out), "--json", str(self.json)]
        if asked:
            words += ["--recordings", str(self.folder / "?.h5"), "--bundle", str(self.bundle)]
            words += [] if operation == "recalibrate" else ["--range-pages", str(RANGE)]
        status = run_command(command.bulk, [*words, *options])
        return status, json.loads(self.json.read_text()) if self.json.exists() else {}

    def records(self) -> dict[str, ShardRecord]:
        """All shards by name."""
        found = sorted(self.out.glob("shards/*/*.json"))
        return {f"{path.parent.name}/{path.stem}": ShardRecord.read(path.with_suffix("")) for path in found}


@pytest.fixture
def archive(tmp_path: Path, toy_zip: Path, monkeypatch: pytest.MonkeyPatch) -> Archive:
    return Archive(tmp_path, toy_zip, monkeypatch)


def test_every_page_is_in_one_range_and_its_symbols_are_those_that_were_written(archive: Archive) -> None:
    status, figures = archive.run("decode")
    assert (status, figures["pages"], figures["pages_read"], figures["pages_missing"]) == (0, 14, 14, 0)
    read = {(index, page.page) for index in "01" for page in _pages(archive, index)}
    assert len(read) == 14
    assert [len(task.pages) for task in archive.tasks] == [3, 3, 1] * 2
    written = toy.symbols_of(16, 1, PAGES)
    for shard in sorted(archive.out.glob("shards/000000/*.h5")):
        with h5py.File(shard) as file:
            assert (file["symbols"][()] == written[file["pages"][()]]).all()
            assert set(file["model_versions"].asstr()[()]) == {"toy-1"}


def _pages(archive: Archive, index: str) -> list[Any]:
    return [
        page for name, record in archive.records().items() if name.startswith(f"00000{index}") for page in record.pages
    ]


def test_a_second_run_does_nothing_and_goes_on_without_being_told_what_was_asked(archive: Archive) -> None:
    archive.run("decode", "--no-symbols")
    before = archive.records()
    assert {record.worker.rpartition(":")[2] for record in before.values()} == {str(os.getpid())}
    status, figures = archive.run("decode", asked=False)
    assert (status, archive.tasks, figures["this_run"]["pages"], figures["pages_read"]) == (0, [], 0, 14)
    assert archive.records() == before
    assert not list(archive.out.glob("shards/*/*.h5"))


def test_a_run_that_an_earlier_version_began_goes_on(archive: Archive) -> None:
    archive.run("decode")
    path = archive.out / "job.json"
    job = json.loads(path.read_text())
    for name in ("fine_tuning", "parts"):
        del job["choices"][name]
    job["choices"]["known_pages"] = 2
    for source in job["sources"]:
        del source["run"]
    path.write_text(json.dumps(job))
    status, figures = archive.run("decode")
    assert (status, archive.tasks, figures["pages_read"]) == (0, [], 14)


def test_a_run_over_finished_work_loads_nothing_that_decodes(archive: Archive) -> None:
    archive.run("evaluate")
    script = """
import sys
from lightpage.cli.main import run
from runtime.commands.bulk import bulk
status = run(bulk, sys.argv[1:])
assert not (found := {"onnxruntime", "ray", "grpc", "prometheus_client"} & sys.modules.keys()), found
sys.exit(status)
"""
    again = [sys.executable, "-c", script, "evaluate", str(archive.out)]
    done = subprocess.run(again, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "nothing was missing" in done.stdout


def test_only_what_is_missing_is_done(archive: Archive) -> None:
    archive.run("evaluate")
    (archive.out / "shards/000001/00000003.json").unlink()
    status, _ = archive.run("evaluate")
    assert status == 0
    assert [(task.recording.name, task.pages) for task in archive.tasks] == [("b.h5", (3, 4, 5))]


def test_an_evaluation_in_ranges_says_what_one_of_the_whole_says(archive: Archive) -> None:
    toy.write_toy_recording(archive.folder / "a.h5", toy.ToyDevice(noise=60.0, seed=1), 64, PAGES)
    (archive.folder / "b.h5").unlink()
    decoder = Decoder(Bundle.open(archive.bundle), threads=1)
    _, figures = archive.run("evaluate", "--no-tracking")
    with Recording.open(archive.folder / "a.h5") as recording:
        whole = evaluate(decoder, recording, NoTracker(decoder)).to_json()
    assert whole["symbol_error_rate"] > 0.1
    for name in ("air_bits_per_symbol", "own_mi_bits_per_symbol", "symbol_error_rate", "ece"):
        assert figures["figures"][name] == pytest.approx(whole[name], rel=1e-12)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--range-pages", "4"), "range_pages: got 4, and 3 before"),
        (("--no-tracking",), "tracking: got False, and True before"),
        (("--recordings", "c.h5"), "c.h5, which was not asked for before"),
    ],
)
def test_another_question_to_the_same_folder_is_refused(
    archive: Archive, options: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    archive.run("decode")
    shutil.copy(archive.folder / "a.h5", archive.folder / "c.h5")
    monkeypatch.chdir(archive.folder)
    status, _ = archive.run("decode", *options, asked=False)
    assert (status, archive.tasks) == (2, [])
    assert told in capsys.readouterr().err


def test_another_operation_or_bundle_is_refused_too(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    archive.run("decode")
    assert archive.run("evaluate", asked=False)[0] == 2
    assert "operation: got evaluate, and decode before" in capsys.readouterr().err
    toy.write_toy_bundle(archive.folder / "other.zip", version="toy-2")
    assert archive.run("decode", "--bundle", str(archive.folder / "other.zip"), asked=False)[0] == 2
    assert "toy-2" in capsys.readouterr().err


def test_a_second_driver_is_refused(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    with Ledger(archive.out):
        assert archive.run("decode")[0] == 75
        assert archive.run("decode", "--part", "0/2")[0] == 75
    assert "another run at work there" in capsys.readouterr().err
    assert archive.run("decode")[0] == 0


def test_each_part_does_its_recordings_and_the_whole_is_added_up_without_parts(archive: Archive) -> None:
    shutil.copy(archive.folder / "a.h5", archive.folder / "c.h5")
    done = []
    for part, names in (("1/2", {"b.h5"}), ("0/2", {"a.h5", "c.h5"})):
        status, figures = archive.run("evaluate", "--part", part)
        assert {task.recording.name for task in archive.tasks} == names
        assert (status, figures["part"], figures["pages_missing"]) == (0, part, 0)
        assert figures["pages"] == figures["this_run"]["pages"] == PAGES * len(names)
        done += [row["recording"] for row in figures["recordings"]]
    status, figures = archive.run("evaluate", asked=False)
    assert (status, archive.tasks, figures["part"], figures["pages_read"]) == (0, [], None, 3 * PAGES)
    assert sorted(done) == [row["recording"] for row in figures["recordings"]]


def test_parts_run_beside_each_other_but_not_twice_nor_beside_the_whole(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    left = archive.out / "shards/000000/.00000003.h5-abc"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"of part 0, which is at work")
    with Ledger(archive.out, Part(index=0, count=2)):
        assert archive.run("decode", "--part", "0/2")[0] == 75
        assert archive.run("decode")[0] == 75
        assert archive.run("decode", "--part", "1/2")[0] == 0
    assert left.exists()
    assert archive.run("decode", "--part", "0/3")[0] == 2
    assert "parts: got 3, and 2 before" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["2/2", "-1/2", "1", "a/b", "0/0", "1/2/3"])
def test_a_part_that_makes_no_sense_is_refused(archive: Archive, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert archive.run("decode", "--part", text)[0] == 2
    assert f"--part: got '{text}', wanted K/N" in capsys.readouterr().err
    assert not archive.out.exists()


def test_a_part_waits_for_another_one_that_writes_down_what_is_asked(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ledger_module, "_QUESTION_S", 0.0)
    with Ledger(archive.out, Part(index=0, count=2)) as ledger, ledger.question():
        assert archive.run("decode", "--part", "1/2")[0] == 75
    assert archive.run("decode", "--part", "1/2")[0] == 0


def test_storage_without_locks_is_named(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    assert archive.run("decode")[0] == 2
    assert "HDF5_USE_FILE_LOCKING=FALSE" in capsys.readouterr().err
    monkeypatch.setenv("HDF5_USE_FILE_LOCKING", "FALSE")
    assert archive.run("decode")[0] == 0


def test_recordings_that_vanish_or_change_are_named_and_the_others_go_on(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    def spoil(task: Task) -> None:
        if task.recording.name == "a.h5" and task.pages[0] == RANGE:
            (archive.folder / "a.h5").rename(archive.folder / "a.gone")

    archive.before_each = spoil
    status, figures = archive.run("decode")
    assert (status, figures["pages_read"], figures["pages_missing"]) == (75, RANGE + PAGES, PAGES - RANGE)
    assert [task.pages[0] for task in archive.tasks if task.recording.name == "a.h5"] == [0, RANGE]
    assert "a.h5: got No such file" in capsys.readouterr().err
    archive.before_each = lambda task: None
    (archive.folder / "a.gone").rename(archive.folder / "a.h5")
    os.utime(archive.folder / "a.h5")
    assert archive.run("decode")[0] == 75
    assert "changed since" in capsys.readouterr().err


def test_a_recording_that_cannot_be_opened_is_named_and_tried_again(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (archive.folder / "b.h5").read_bytes()
    (archive.folder / "b.h5").write_bytes(whole[:1000])
    status, figures = archive.run("decode")
    assert (status, figures["pages_read"]) == (75, PAGES)
    told = capsys.readouterr().err
    assert "b.h5" in told
    assert "0 of 7 lost and 0 missing, 1 ranges or recordings without a result" in told
    assert archive.run("decode")[0] == 75
    assert re.search(r"^this run +0 pages$", capsys.readouterr().out, re.MULTILINE)  # which is not all that there is
    (archive.folder / "b.h5").write_bytes(whole)
    status, figures = archive.run("decode")
    assert (status, figures["pages_read"], {task.recording.name for task in archive.tasks}) == (0, 14, {"b.h5"})


def spoil_page(path: Path, page: int) -> None:
    with h5py.File(path, "r+") as file:
        file["in_phase"][page] = 0


def test_a_lost_page_is_named_once_and_its_neighbours_are_read(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil_page(archive.folder / "a.h5", 4)
    (archive.folder / "b.h5").rename(archive.folder / "b.gone")
    (archive.folder / "b.h5").touch()
    assert archive.run("decode")[0] == 75  # something is missing, whatever is lost
    (archive.folder / "b.gone").rename(archive.folder / "b.h5")
    status, figures = archive.run("decode")
    assert (status, figures["pages_read"], figures["lost"]) == (2, 13, {"BlackFrameError": 1})
    assert figures["recordings"][0]["lost_pages"] == {"BlackFrameError": "4"}
    assert "page 4" in capsys.readouterr().err
    assert archive.run("decode")[0] == 2  # it stays lost, and is not tried again
    assert archive.tasks == []


def test_a_newer_model_reads_only_what_was_not_read_well_and_the_difference_is_told(archive: Archive) -> None:
    device = toy.ToyDevice(offsets=(158.0, 110.0), seed=3)
    toy.write_toy_recording(archive.folder / "b.h5", device, 16, PAGES, 5)
    status, figures = archive.run("evaluate")
    lost, due = figures["pages_lost"], figures["pages_recalibration_due"]
    assert (status, lost + due, figures["recordings"][0]["pages_read"]) == (2, PAGES, PAGES)
    decoder = Decoder(Bundle.open(archive.bundle), threads=1)
    toy.write_toy_recording(archive.folder / "known", device, 16, 2, 6)
    better = _recalibrated(decoder, archive.folder / "known", archive.folder / "new.zip")
    status, figures = archive.run("evaluate", "--again-with", str(better), asked=False)
    assert {task.recording.name for task in archive.tasks} == {"b.h5"}
    assert sum(len(task.pages) for task in archive.tasks) == PAGES
    told = figures["rounds"][0]
    assert (told["pages"], told["pages_won"] + told["pages_better"]) == (PAGES, figures["models"]["toy-1+r1"])
    assert told["air_after"] > told["air_before"]
    assert (status, figures["pages_read"], told["pages_lost_still"]) == (0, 2 * PAGES, 0)
    assert archive.run("evaluate", "--again-with", str(better), asked=False)[0] == 0
    assert archive.tasks == []


def _recalibrated(decoder: Decoder, recording: Path, out: Path) -> Path:
    from runtime.recalibration.known_pages import read_recorded
    from runtime.recalibration.recalibration import recalibrate

    with Recording.open(recording) as file:
        known = read_recorded(file, range(2))
    recalibrate(decoder, known, out, "toy-1+r1", toy.fit_references, lambda *_: None)
    return out


def test_what_a_killed_worker_left_is_swept(archive: Archive) -> None:
    archive.run("decode")
    left = archive.out / "shards/000000/.00000003.h5-abc"
    left.write_bytes(b"half")
    archive.run("decode")
    assert not left.exists()


def test_files_come_back_from_pages_in_several_recordings(archive: Archive) -> None:
    bundle = coded.bundle(archive.folder / "coded.zip")
    pages = coded.pages(bundle, archive.folder)
    (archive.folder / "pages.h5").rename(archive.folder / "pages.sent")
    coded.recording(archive.folder / "a.h5", pages[:8], {2: coded.dark}, code=None)
    coded.recording(archive.folder / "b.h5", pages[8:])
    status, figures = archive.run("recover", "--no-tracking", "--bundle", str(bundle))
    assert (status, figures["pages_lost"]) == (0, 1)
    file = Path(figures["files"][0]["file"])
    assert file.read_bytes() == coded.CONTENT
    assert figures["files"][0]["restored"] == [2]
    made = file.stat().st_mtime_ns
    left = file.with_name(f"{file.name}.0.partial")  # of a run that was killed
    left.touch()
    assert archive.run("recover", asked=False)[0] == 0
    assert (file.stat().st_mtime_ns, left.exists()) == (made, False)
    shutil.rmtree(archive.out)
    for part, lost in (("0/2", 1), ("1/2", 0)):
        status, figures = archive.run("recover", "--no-tracking", "--bundle", str(bundle), "--part", part)
        assert (status, figures["pages_lost"], figures["files"]) == (0, lost, [])
    status, figures = archive.run("recover", asked=False)
    assert (status, archive.tasks, file.read_bytes()) == (0, [], coded.CONTENT)


def test_a_file_whose_pages_do_not_suffice_is_not_written(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    bundle = coded.bundle(archive.folder / "coded.zip")
    pages = coded.pages(bundle, archive.folder)
    (archive.folder / "pages.h5").rename(archive.folder / "pages.sent")
    coded.recording(archive.folder / "a.h5", pages[:8], {0: coded.dark, 1: coded.dark, 2: coded.dark})
    coded.recording(archive.folder / "b.h5", pages[8:])
    status, figures = archive.run("recover", "--no-tracking", "--bundle", str(bundle))
    assert (status, figures["files"][0]["file"], figures["files"][0]["lost"]) == (3, None, [0, 1, 2])
    assert list((archive.out / "files").iterdir()) == []
    assert "volumes 9 without a file" in capsys.readouterr().err


def test_a_file_of_one_volume_is_written_with_holes_under_a_name_of_its_own(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = coded.bundle(archive.folder / "coded.zip")
    pages = coded.pages(bundle, archive.folder)
    (archive.folder / "pages.h5").rename(archive.folder / "pages.sent")
    coded.recording(archive.folder / "a.h5", pages[:8], {0: coded.dark, 1: coded.dark, 2: coded.dark})
    coded.recording(archive.folder / "b.h5", pages[8:])
    asked = ("recover", "--no-tracking", "--bundle", str(bundle))
    for _ in range(2):  # the second time it is made again
        status, figures = archive.run(*asked, "--holes")
        (told,) = figures["files"]
        holes = Path(told["file_with_holes"])
        assert (status, told["file"], told["lost"]) == (3, None, [0, 1, 2])
        found, lost = holes.read_bytes(), 3 * len(coded.CONTENT) // (len(pages) - 1)
        assert len(found) == len(coded.CONTENT)
        assert not any(found[: lost // 2])
        assert found[-100:] == coded.CONTENT[-100:]
        assert [path.name for path in (archive.out / "files").iterdir()] == [holes.name]
    assert f"zeros in {holes}" in capsys.readouterr().out
    assert archive.run(*asked, "--volume", "9")[1]["files"][0]["file_with_holes"] == str(holes)  # it is there still
    assert archive.run(*asked, "--volume", "8:12")[0] == 2
    assert "--volume: got 8:00000012, wanted a volume of the recordings: 9:" in capsys.readouterr().err


def test_one_volume_alone_leaves_what_is_known_of_the_others_and_a_whole_file_needs_no_holes(archive: Archive) -> None:
    bundle = coded.bundle(archive.folder / "coded.zip")
    pages = coded.pages(bundle, archive.folder)
    (archive.folder / "pages.h5").rename(archive.folder / "pages.sent")
    coded.recording(archive.folder / "a.h5", pages[:8])
    coded.recording(archive.folder / "b.h5", pages[8:])
    asked = ("recover", "--no-tracking", "--bundle", str(bundle))
    (told,) = archive.run(*asked)[1]["files"]
    note, file = archive.out / "files.json", Path(told["file"])
    note.write_text(json.dumps([{**told, "volume": 3}, told]))
    file.unlink()
    holes = file.with_name(file.name + ".holes")
    holes.write_bytes(b"from before the last page came")
    assert archive.run(*asked, "--volume", "9")[0] == 0
    assert [each["volume"] for each in json.loads(note.read_text())] == [3, 9]
    assert file.read_bytes() == coded.CONTENT
    assert not holes.exists()


def test_a_code_of_its_own_reads_pages_whose_recording_and_bundle_have_none(archive: Archive) -> None:
    bundle = coded.bundle(archive.folder / "coded.zip")
    pages = coded.pages(bundle, archive.folder)
    (archive.folder / "pages.h5").rename(archive.folder / "pages.sent")
    for name, some in (("a", pages[:8]), ("b", pages[8:])):
        coded.recording(archive.folder / f"{name}.h5", some, code=None)
    asked = ("recover", "--no-tracking", "--bundle", str(archive.folder / "toy.zip"))
    assert archive.run(*asked)[0] == 75
    shutil.rmtree(archive.out)
    coded.CODE.save(archive.folder / "code.toml")
    status, figures = archive.run(*asked, "--code", str(archive.folder / "code.toml"))
    assert status == 0
    assert Path(figures["files"][0]["file"]).read_bytes() == coded.CONTENT
    assert archive.run("recover", asked=False)[0] == 0  # the code is part of what was asked
    assert archive.tasks == []


def test_pages_are_computed_with_the_provider_that_is_asked_for(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    assert archive.run("decode", "--provider", "cuda")[0] == 75
    assert {task.provider for task in archive.tasks} == {"cuda"}
    assert "provider cuda: got an onnxruntime with" in capsys.readouterr().err
    assert archive.run("decode", "--provider", "gpu")[0] == 2
    assert "provider: got 'gpu', wanted cpu, cuda or tensorrt" in capsys.readouterr().err


def test_pages_without_any_bytes_are_lost_data(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    bundle = coded.bundle(archive.folder / "coded.zip")
    status, figures = archive.run("recover", "--no-tracking", "--bundle", str(bundle))
    assert (status, figures["files"], figures["pages_missing"]) == (75, [], 14)  # of other levels than the code
    for name in "ab":
        toy.write_toy_recording(archive.folder / f"{name}.h5", toy.ToyDevice(), coded.CODE.levels, 2)
    shutil.rmtree(archive.out)
    assert archive.run("recover", "--no-tracking", "--bundle", str(bundle))[0] == 3
    assert "no file; 4 of 4 lost" in capsys.readouterr().err


def test_a_poisoned_device_fails_by_name_and_the_rest_of_the_fleet_is_recalibrated(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    offsets = {"left": (148.0, 90.0), "right": (118.0, 70.0)}
    lines = []
    for name, drifted in offsets.items():
        toy.write_toy_recording(archive.folder / f"{name}.h5", toy.ToyDevice(drifted, seed=4), 16, 3, 6)
        lines += [f'[[device]]\nname = "{name}"\nbundle = "toy.zip"\nrecordings = ["{name}.h5"]']
    toy.write_toy_recording(archive.folder / "bad.h5", toy.ToyDevice(seed=4), 16, 3, 6)
    with h5py.File(archive.folder / "bad.h5", "r+") as file:
        file["symbols"][:] = toy.symbols_of(16, 999, 3)
    lines += ['[[device]]\nname = "poisoned"\nbundle = "toy.zip"\nrecordings = ["bad.h5"]']
    (archive.folder / "fleet.toml").write_text("\n".join(lines))
    fleet = ("--fleet", str(archive.folder / "fleet.toml"))
    for index, name in enumerate(offsets):  # one part, one device
        status, figures = archive.run("recalibrate", *fleet, "--part", f"{index}/3", asked=False)
        assert (status, [row["device"] for row in figures["devices"]]) == (0, [name])
    status, figures = archive.run("recalibrate", *fleet, asked=False)
    assert [task.device for task in archive.tasks] == ["poisoned"]
    assert (status, figures["pages_read"], figures["pages_lost"]) == (2, 2, 1)
    rows = {row["device"]: row for row in figures["devices"]}
    assert rows["poisoned"]["state"] == "refused"
    for name, drifted in offsets.items():
        assert rows[name]["air_after"] > rows[name]["air_before"]
        made = Bundle.open(rows[name]["bundle"])
        assert made.version == "toy-1+r1"
        assert made.table["reference_in_phase"].mean() == pytest.approx(drifted[0])
    assert f"device poisoned: recording {archive.folder / 'bad.h5'}: " in capsys.readouterr().err
    assert archive.run("recalibrate", *fleet, asked=False)[0] == 2
    assert archive.tasks == []


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("device = 3", "[[device]] tables"),
        ("[[device]]\nname='a'\nbundle='toy.zip'\nrecordings=['a.h5']\n" * 2, "devices a, a"),
        ("[[device]]\nname='a'\nbundle='toy.zip'\nrecordings=[]", "at least 1 item"),
        ("[[device]]\nname=''\nbundle='toy.zip'\nrecordings=['a.h5']", "at least 1 character"),
    ],
)
def test_a_fleet_that_makes_no_sense_is_refused(
    archive: Archive, text: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (archive.folder / "fleet.toml").write_text(text)
    assert archive.run("recalibrate", "--fleet", str(archive.folder / "fleet.toml"), asked=False)[0] == 2
    assert told in capsys.readouterr().err


def test_ctrl_c_keeps_what_is_done(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(task: Task) -> None:
        if len(archive.tasks) == 2:
            raise KeyboardInterrupt

    archive.before_each = interrupt
    assert archive.run("decode")[0] == 130
    assert "what is done stays" in capsys.readouterr().err
    assert len(archive.records()) == 2
    archive.before_each = lambda task: None
    status, figures = archive.run("decode")
    assert (status, len(archive.tasks), figures["pages_read"]) == (0, 4, 14)


def test_a_shard_that_is_damaged_is_named(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    archive.run("decode")
    (archive.out / "shards/000000/00000000.json").write_text("{}")
    assert archive.run("decode")[0] == 2
    assert "00000000.json" in capsys.readouterr().err


def test_errors_keep_their_parts() -> None:
    from runtime.scaling.task import Problem

    error = InvalidInputError("a", "b", "c")
    assert str(Problem.of(error)) == str(LightpageError("a", "b", "c"))


@pytest.mark.parametrize("name", ["a[1].h5", "what?.h5", "all*.h5", "-dash.h5", " space .h5", "line\nbreak.h5", "ü.h5"])
def test_a_file_that_exists_under_exactly_that_name_is_meant(name: str, archive: Archive) -> None:
    folder = archive.folder / "[shelf]"
    folder.mkdir()
    (archive.folder / "a.h5").rename(folder / name)
    for asked in (str(folder / name), f"{folder}/*.h5"):
        words = ["--recordings", asked, "--bundle", str(archive.bundle), "--no-symbols"]
        assert archive.run("decode", *words, asked=False)[0] == 0
        assert {task.recording for task in archive.tasks} == {folder / name}
        shutil.rmtree(archive.out)
    (archive.folder / "[shelf]" / "fleet.toml").write_text(
        f'[[device]]\nname = "one"\nbundle = "../toy.zip"\nrecordings = [{json.dumps(name, ensure_ascii=False)}]\n'
    )
    assert archive.run("decode", "--fleet", str(folder / "fleet.toml"), asked=False)[0] == 0


def test_a_home_folder_may_be_named(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(archive.folder))
    assert [path.name for path in found_recordings(["~/?.h5"])] == ["a.h5", "b.h5"]
