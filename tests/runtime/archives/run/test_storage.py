"""A fault of storage is no finding about a page: ranges are missing until it answers, and lost on request alone."""

import errno
import json
import subprocess
import sys
from unittest.mock import Mock

import pytest

from lightpage.errors import StorageError
from lightpage.runtime.archives.run.driver import AGAIN_S
from tests.runtime import toy
from tests.runtime.archives.archive import PAGES, RANGE, Archive
from tests.storage_fault import StorageFault

BAD_PAGE = 4


def test_pages_are_given_up_on_request_alone_and_read_again_on_another(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, options = archive.shows_a_file()
    with monkeypatch.context() as patch:
        toy.frames_fail(patch, StorageError("page", "Input/output error", "data"), BAD_PAGE, of="a.h5")
        status, figures = archive.run("recover", *options)
        assert (status, figures["pages_lost"], figures["pages_missing"]) == (75, 0, RANGE)
        assert archive.clock.now() == sum(AGAIN_S)
        status, figures = archive.run("recover", *options, "--give-up")
        assert (status, figures["lost"], figures["pages_missing"]) == (0, {"storage": 1}, 0)  # parity completes it
    assert archive.run("recover", *options)[1]["lost"] == {"storage": 1}
    status, figures = archive.run("recover", *options, "--retry-lost")
    assert (status, figures["lost"], archive.firsts()) == (0, {}, [("a", RANGE)])


RUNS = """
import os, sys, time
from lightpage.cli.main import lightpage, run
from lightpage.runtime.commands.archives import bulk
from lightpage.runtime.archives.workers.work import Worker
time.sleep = lambda seconds: None
class Inline:
    restarts, in_flight, workers_alive = 0, 0, 1
    def run(self, tasks):
        yield from map(Worker(1).work, tasks)
bulk.engine_of = lambda *_: Inline()
def ends(number):
    return run(lightpage, [*sys.argv[1:], "--json", f"{number}.json"])
assert ends(0) == 75
del os.environ["FAULT_OPEN"]
assert ends(1) == 75
os.unlink(os.environ["FAULT_FLAG"])
assert ends(2) == 0
"""


def test_faults_of_the_disk_below_hdf5_are_understood(archive: Archive) -> None:
    """First its recording cannot be opened, then its frames cannot be read."""
    fault = StorageFault.compiled(archive.folder, "a.h5", errno.EIO, least_bytes=6000)
    fault.flag.touch()
    words = ["bulk", "decode", str(archive.out), "--recordings", str(archive.folder / "?.h5")]
    command = [sys.executable, "-c", RUNS, *words, "--bundle", str(archive.bundle)]
    done = subprocess.run(command, env=fault.environment, cwd=archive.folder, timeout=120, capture_output=True)
    assert (done.returncode, b"Traceback" in done.stderr) == (0, False)
    told = [json.loads((archive.folder / f"{number}.json").read_text()) for number in range(3)]
    assert [(each["pages_lost"], each["pages_read"]) for each in told] == [(0, PAGES), (0, PAGES), (0, 2 * PAGES)]
    opened, read = (each["this_run"]["problems"][0] for each in told[:2])
    assert "nput/output error" in opened
    assert "input/output error" in read
    assert [each["pages_missing"] for each in told] == [0, PAGES, 0]  # a recording that was not opened has none


def test_a_file_that_storage_does_not_take_is_not_lost(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    _, options = archive.shows_a_file()
    with monkeypatch.context() as patch:
        for number in (errno.EIO, errno.ENOSPC):
            patch.setattr("lightpage.codec.volume_file.move_into_place", Mock(side_effect=OSError(number, "")))
            assert archive.run("recover", *options)[0] == 75
    status, figures = archive.run("recover", *options)
    assert (status, archive.tasks, len(figures["files"])) == (0, [], 1)
