"""`lightpage bulk`: every page once, whatever happens in between, and what is done is not done again."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import h5py
import pytest

from lightpage.codec import page_codec
from lightpage.codec.page_codec import PageCodec
from lightpage.errors import StorageError
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import evaluate
from lightpage.runtime.archives.run.driver import AGAIN_S
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from tests.runtime import coded, toy
from tests.runtime.archives.archive import PAGES, RANGE, Archive

ROOT = Path(__file__).resolve().parents[4]


def test_every_page_is_read_once_and_a_second_run_does_what_is_missing(archive: Archive) -> None:
    status, figures = archive.run("decode")
    assert (status, figures["pages"], figures["pages_read"], figures["pages_missing"]) == (0, 14, 14, 0)
    assert archive.firsts() == [(name, first) for name in "ab" for first in (0, 3, 6)]
    written = toy.symbols_of(16, 1, PAGES)
    for first in (0, 3, 6):
        with h5py.File(archive.out / f"shards/000000/{first:08d}.h5") as file:
            assert list(file["pages"]) == list(range(first, min(first + RANGE, PAGES)))
            assert (file["symbols"][()] == written[file["pages"][()]]).all()
            assert set(file["model_versions"].asstr()[()]) == {"toy-1"}
    before = archive.records()
    assert {record.worker.rpartition(":")[2] for record in before.values()} == {str(os.getpid())}
    (archive.out / "shards/000001/00000003.json").unlink()
    status, figures = archive.run("decode")
    assert (status, archive.firsts()) == (0, [("b", 3)])
    assert figures["this_run"]["pages"] == RANGE
    status, figures = archive.run("decode", asked=False)  # it knows what was asked
    assert (status, archive.tasks, figures["this_run"]["pages"], figures["pages_read"]) == (0, [], 0, 14)
    (archive.out / "shards/000000/00000000.json").write_text("{}")
    assert archive.run("decode")[0] == 2


def test_a_run_over_finished_work_loads_nothing_that_decodes(archive: Archive) -> None:
    archive.run("decode", "--no-symbols")
    assert not list(archive.out.glob("shards/*/*.h5"))
    script = """
import sys
from lightpage.cli.main import run
from lightpage.runtime.commands.archives.bulk import bulk
status = run(bulk, sys.argv[1:])
assert not (found := {"onnxruntime", "ray", "grpc", "prometheus_client"} & sys.modules.keys()), found
sys.exit(status)
"""
    again = [sys.executable, "-c", script, "decode", str(archive.out)]
    done = subprocess.run(again, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (0, "")


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


def test_another_question_or_a_second_run_in_the_same_folder_is_refused(archive: Archive) -> None:
    with Ledger(archive.out):
        assert archive.run("decode")[0] == 75
        assert archive.run("decode", "--part", "0/2")[0] == 75
    assert archive.run("decode", "--provider", "gpu")[0] == 2
    assert not archive.records()
    assert archive.run("decode", asked=False)[0] == 2
    assert archive.run("decode")[0] == 0
    toy.write_toy_bundle(archive.folder / "other.zip", version="toy-2")
    other = ("decode", "--bundle", str(archive.folder / "other.zip"))
    for question in (("evaluate",), other, ("decode", "--part", "0/2")):
        assert archive.run(*question, asked=False) == (2, {})
        assert archive.tasks == []


def test_a_recording_that_opens_at_the_second_try_costs_a_second(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries, opened = iter([StorageError("recording", "Input/output error", "data")]), Recording.open

    def hiccup(path: Path) -> Recording:
        if (error := next(tries, None)) is not None:
            raise error
        return opened(path)

    monkeypatch.setattr(Recording, "open", hiccup)
    assert archive.run("decode")[0] == 0
    assert archive.clock.now() == AGAIN_S[0]


def test_files_come_back_from_pages_in_several_recordings(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_codec, "PageCodec", codec := Mock(wraps=PageCodec))
    _, options = archive.shows_a_file({2: coded.dark})
    status, figures = archive.run("recover", *options, "--code-threads", "3")
    assert {call.args[3] for call in codec.call_args_list} == {3}
    assert (status, figures["pages_lost"]) == (0, 1)
    (told,) = figures["files"]
    file = Path(told["file"])
    assert (file.read_bytes(), told["restored"]) == (coded.CONTENT, [2])
    made = file.stat().st_mtime_ns
    assert archive.run("recover", asked=False)[0] == 0
    assert file.stat().st_mtime_ns == made
    (note := archive.out / "files.json").write_text(json.dumps([{**told, "volume": 3}, told]))
    file.unlink()
    assert archive.run("recover", "--volume", "9", asked=False)[0] == 0
    assert [each["volume"] for each in json.loads(note.read_text())] == [3, 9]
    shutil.rmtree(archive.out)
    coded.CODE.save(archive.folder / "code.toml")
    asked = ("--no-tracking", "--code", str(archive.folder / "code.toml"))  # a bundle without one
    for part, lost in (("0/2", 1), ("1/2", 0)):
        status, figures = archive.run("recover", *asked, "--part", part)
        assert (status, figures["pages_lost"], figures["files"]) == (0, lost, [])
    status, figures = archive.run("recover", asked=False)
    assert (status, archive.tasks, file.read_bytes()) == (0, [], coded.CONTENT)


def test_a_file_whose_pages_do_not_suffice_is_written_with_holes_on_request_under_a_name_of_its_own(
    archive: Archive,
) -> None:
    pages, options = archive.shows_a_file(dict.fromkeys(range(3), coded.dark))
    status, figures = archive.run("recover", *options)
    assert (status, figures["files"][0]["file"], figures["files"][0]["lost"]) == (3, None, [0, 1, 2])
    assert list((archive.out / "files").iterdir()) == []
    for _ in range(2):  # the second time it is made again
        status, figures = archive.run("recover", *options, "--holes")
        (told,) = figures["files"]
        holes = Path(told["file_with_holes"])
        assert (status, told["file"], told["lost"]) == (3, None, [0, 1, 2])
        found, lost = holes.read_bytes(), 3 * len(coded.CONTENT) // (len(pages) - 1)
        assert (len(found), any(found[: lost // 2]), found[-9:]) == (1000, False, coded.CONTENT[-9:])
        assert [path.name for path in (archive.out / "files").iterdir()] == [holes.name]
    (told,) = archive.run("recover", *options, "--volume", "9")[1]["files"]
    assert told["file_with_holes"] == str(holes)  # it is there still
    assert archive.run("recover", *options, "--volume", "8:12")[0] == 2
