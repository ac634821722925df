"""What a run has found, added up from its shards."""

from pathlib import Path

import pytest

from lightpage.runtime.archives.run.ledger import Ledger, Part
from lightpage.runtime.archives.run.shard import PageRecord, PageState, ShardRecord
from lightpage.runtime.archives.run.task import Operation
from lightpage.runtime.archives.run.totals import AIR, totals
from tests.runtime.archives.jobs import BUNDLE, NEWER, PAGES, STAYS, job, lost, page, source, write


def test_pages_are_counted_by_what_became_of_them(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    left_out = PageRecord(page=2, state=PageState.LEFT_OUT)
    write(ledger.shard(0, 0), page(0, 1.0, healed_rounds=0, **{AIR: 4.0}), page(1, 3.0, True, **{AIR: 2.0}), left_out)
    write(ledger.shard(1, 3), lost(3), lost(4, None, "no reason"), lost(5))
    asked = job(source("a"), source("b"), source("c", STAYS))
    found = totals(ledger, asked)
    assert (found.pages, found.read, found.left_out, found.missing, found.recalibration_due) == (2 * PAGES, 2, 1, 8, 1)
    assert (found.lost, found.models) == ({"BlackFrameError": 2, "unknown": 1}, {"toy-1": 6})
    assert (found.figures[AIR].value, found.figures[AIR].least, found.figures["none"].value) == (3.0, 2.0, None)
    assert found.figures["confirmed_bits"].value == 2.0
    assert [row["pages_lost"] for row in found.recordings] == [0, 3, 0]
    assert found.recordings[1]["lost_pages"] == {"BlackFrameError": "3, 5", "unknown": "4"}
    assert found.recordings[2]["problem"] == str(STAYS)
    assert found.examples == {
        "BlackFrameError": "recording /b.h5: page 3: black",
        "unknown": "recording /b.h5: page 4: no reason",
    }
    assert [(each.worker, each.pages, each.read_bytes) for each in found.readings] == [("here:1", 3, 5)] * 2
    assert [(name, group.recordings, group.told) for name, group in found.groups.items()] == [
        ("/a.h5", 1, ""),
        ("/b.h5", 1, "black"),
        ("/c.h5", 1, str(STAYS)),
    ]
    told = found.to_json()
    assert [row["pages_healed"] for row in (told, *found.recordings)] == [1, 1, 0, 0]
    assert (told["pages"], told["pages_read"], told["pages_lost"], told["pages_missing"]) == (14, 2, 3, 8)
    part = totals(Ledger(tmp_path, Part(index=1, count=3)), asked)
    assert (part.pages, part.lost.total(), len(part.recordings)) == (PAGES, 3, 1)


def test_a_round_says_what_it_has_brought(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    write(ledger.shard(0, 0), lost(0), lost(1), page(2, 1.0, True, **{AIR: 1.0}))
    write(ledger.shard(0, 3), page(3, 2.0, True, **{AIR: 2.0}))
    write(ledger.shard(0, 0, 1), page(0, 3.0, **{AIR: 3.0}), lost(1), page(2, 2.0, **{AIR: 2.0}), model=NEWER)
    write(ledger.shard(0, 3, 1), page(3, 1.0, **{AIR: 0.5}), model=NEWER)
    found = totals(ledger, job(source("a"), rounds=(NEWER,)))
    assert found.rounds[0].to_json() == {
        "version": "toy-2",
        "pages": 4,
        "pages_won": 1,
        "pages_better": 1,
        "pages_lost_still": 1,
        "air_before": 1.0,  # of a lost page nothing, and (0 + 1 + 2) / 3 of those whose AIR is known
        "air_after": pytest.approx(7 / 3),
    }
    assert (found.read, found.models) == (3, {"toy-2": 2, "toy-1": 2})
    assert [reading.pages for reading in found.readings] == [3, 3, 1, 1]


def test_a_range_that_is_read_again_is_missing_whatever_a_round_found_of_it(tmp_path: Path) -> None:
    ledger, asked = Ledger(tmp_path), job(source("a"), rounds=(NEWER,))
    write(ledger.shard(0, 0), lost(0), lost(1), lost(2))
    write(ledger.shard(0, 3), page(3))
    write(ledger.shard(0, 0, 1), page(0, 3.0), lost(1), page(2), model=NEWER)
    ledger.doubt_losses(asked)
    told = totals(ledger, asked).to_json()
    assert (told["pages"], told["pages_read"], told["pages_lost"], told["pages_missing"]) == (PAGES, 1, 0, PAGES - 1)


def test_devices_have_a_row_each_that_says_why(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    sources = (source("a1", device="a"), source("a2", device="a"), source("b", device="b"), source("c", device="c"))
    write(ledger.shard(0, 0), page(0))
    done = ShardRecord.read(ledger.shard(0, 0))
    done.model_copy(update={"summary": {"air_before": 1.0, "air_after": 2.0}}).write(ledger.shard(0, 0))
    write(ledger.shard(2, 0), lost(0, "RecalibrationRefusedError", "no fit"))
    asked = job(*sources, source("d", STAYS, "d"), source("e", device="e"), operation=Operation.RECALIBRATE)
    found = totals(ledger, asked, {("c", Path("/c.h5")): STAYS})
    rows = {row["device"]: row for row in found.devices}
    assert {name: row["state"] for name, row in rows.items()} == {
        "a": "recalibrated",
        "b": "refused",
        "c": "failed",
        "d": "failed",
        "e": "missing",
    }
    assert (rows["a"]["air_before"], rows["a"]["air_after"]) == (1.0, 2.0)
    assert rows["a"]["bundle"] == str(ledger.shard(0, 0).with_name("00000000.zip"))
    assert rows["a"]["recordings"] == ["/a1.h5", "/a2.h5"]
    assert (rows["b"]["reason"], rows["c"]["reason"], rows["e"]["reason"]) == ("no fit", str(STAYS), "")
    assert found.told == ["device b: recording /b.h5: no fit"]
    assert (found.pages, found.read, found.lost) == (4, 1, {"RecalibrationRefusedError": 1})
    assert BUNDLE.version in found.models
