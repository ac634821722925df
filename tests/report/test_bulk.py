"""`lightpage report` of a bulk run: finished or not, of every operation, and without a change to its folder."""

import html
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from lightpage.errors import LightpageError
from lightpage.report.bulk_figures import rates
from lightpage.report.contents.from_bulk import report_of_bulk, sessions
from lightpage.runtime.archives.run.task import Task
from lightpage.runtime.archives.run.totals import Reading
from tests.report.pages import check_whole, page_of
from tests.runtime import coded, toy
from tests.runtime.archives.archive import PAGES, Archive, archive, spoil_page

__all__ = ["archive"]

SECTIONS = ["figures", "speed", "losses", "devices", "workers"]


def told(text: str) -> str:
    """Return the text that a reader sees, in one line."""
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split())


def test_a_run_that_is_not_finished_is_shown_as_far_as_it_is_and_left_alone(archive: Archive, tmp_path: Path) -> None:
    spoil_page(archive.folder / "a.h5", 4)
    (archive.folder / "c.h5").write_bytes(b"no recording")

    def interrupt(task: Task) -> None:
        if len(archive.tasks) == 3:
            raise KeyboardInterrupt

    archive.before_each = interrupt
    archive.run("decode")
    before = {path: path.stat().st_ctime_ns for path in archive.out.rglob("*")}
    text, seen = page_of(archive.out, tmp_path / "r.html")
    assert {path: path.stat().st_ctime_ns for path in archive.out.rglob("*")} == before
    check_whole(text, seen, SECTIONS)
    assert {name: len(pictures) for name, pictures in seen.pictures.items()} == {"speed": 2, "losses": 1, "devices": 2}
    assert f"{PAGES} of {2 * PAGES} pages" in told(text)
    assert "BlackFrameError 1 7.14% a.h5: page 4" in told(text).replace("recording ", "")
    assert str(archive.folder) not in text


def test_pages_that_were_read_again_and_devices_of_a_fleet(archive: Archive, tmp_path: Path) -> None:
    toy.write_toy_bundle(archive.folder / "newer.zip", version="toy-2")
    spoil_page(archive.folder / "b.h5", 0)
    lines = [f'[[device]]\nname = "<{name}>"\nbundle = "toy.zip"\nrecordings = ["{name}.h5"]' for name in "ab"]
    (archive.folder / "fleet.toml").write_text("\n".join(lines))
    archive.run("evaluate", "--fleet", str(archive.folder / "fleet.toml"), asked=False)
    archive.run("evaluate", "--again-with", str(archive.folder / "newer.zip"), asked=False)
    text, seen = page_of(archive.out, tmp_path / "r.html")
    check_whole(text, seen, [*SECTIONS[:-1], "rounds", "workers"])
    assert "toy-2 1 0 0 1 not known not known" in told(text)
    assert [device.name for device in report_of_bulk(archive.out).devices] == ["<b>", "<a>"]  # the worst first
    assert "&lt;b&gt;" in text
    assert "<b>" not in text


def test_files_that_came_back_and_files_that_did_not(archive: Archive, tmp_path: Path) -> None:
    _, options = archive.shows_a_file({2: coded.dark})
    archive.run("recover", *options)
    text, seen = page_of(archive.out, tmp_path / "r.html")
    check_whole(text, seen, [*SECTIONS[:-1], "files", "workers"])
    assert "1 whole, 0 not" in told(text)
    (archive.out / "files.json").write_text("[")
    with pytest.raises(LightpageError, match=r"files\.json"):
        page_of(archive.out, tmp_path / "r.html")


def test_a_fleet_that_was_recalibrated_tells_why_a_device_failed(archive: Archive, tmp_path: Path) -> None:
    for name in ("left-1", "left-2", "bad", "lost"):
        toy.write_toy_recording(archive.folder / f"{name}.h5", toy.ToyDevice((148.0, 90.0), seed=4), 16, 3, 6)
    with h5py.File(archive.folder / "bad.h5", "r+") as file:
        file["symbols"][:] = toy.symbols_of(16, 999, 3)
    (archive.folder / "lost.h5").write_bytes(b"no recording")
    names = ("left", "bad", "lost")
    lines = [f'[[device]]\nname = "{name}"\nbundle = "toy.zip"\nrecordings = ["{name}*.h5"]' for name in names]
    (archive.folder / "fleet.toml").write_text("\n".join(lines))
    archive.run("recalibrate", "--fleet", str(archive.folder / "fleet.toml"), asked=False)
    text, seen = page_of(archive.out, tmp_path / "r.html")
    check_whole(text, seen, SECTIONS)
    data = report_of_bulk(archive.out)
    assert data.recalibrations is not None
    assert [(each.name, each.state) for each in data.recalibrations] == [
        ("bad", "refused"),
        ("lost", "failed"),
        ("left", "recalibrated"),
    ]
    rows = {each.name: each for each in data.recalibrations}
    assert rows["left"].air_before is not None
    assert rows["left"].air_after is not None
    assert f"bad 1 refused {rows['bad'].reason}" in told(text)
    assert "lost 1 failed recording lost.h5" in told(text)
    assert str(archive.folder) not in text


def test_the_pages_of_a_range_are_spread_over_its_time_and_none_is_lost() -> None:
    readings = [Reading(10.0, 10.0, 20, "a", 0), Reading(10.0, 5.0, 20, "b", 0), Reading(102.0, 1.0, 4, "a", 0)]
    assert sessions(readings) == [(0.0, 10.0), (101.0, 102.0)]
    edges = np.array([0.0, 5.0, 10.0, 200.0])
    pages, workers = rates(readings, edges)
    np.testing.assert_allclose(pages, [2.0, 6.0, 4 / 190])
    np.testing.assert_allclose(workers, [1.0, 2.0, 1 / 190])
    assert (pages * np.diff(edges)).sum() == pytest.approx(44)
