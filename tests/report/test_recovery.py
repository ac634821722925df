"""`lightpage report` of what `lightpage recover --json` writes, and JSON that is neither that nor an evaluation."""

import base64
import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import LOSSES, Loss
from lightpage.codec.volume import Volume
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.report.command import report
from lightpage.report.contents.from_recovery import report_of_recovery
from lightpage.report.json_file import JsonFile
from lightpage.runtime.archives.recordings.recovery import RecoveredPage, Recovery
from tests.lightpage.command import run
from tests.report.pages import check_whole, page_of

SECTIONS = ["figures", "pages", "causes", "unread"]
BLOCKS = 3
CODE = Code(levels=16, coded_bits=2, rate_per_mille=700, corrections=4, needed_information=0.75)
VOLUME = Volume(id=7, file_bytes=5_500, page_bytes=1000, data_pages=4, parity_pages=2)
READ = RecoveredPage(
    0, 0, 7, None, "", margin_bits=0.2, corrected=2, iterations=5.0, air_bits=3.2, seconds=0.5, code_seconds=0.02
)
LOST = [
    RecoveredPage(4, None, None, Loss.OPTICS, "in-phase frame: got black: no count above 0, wanted counts above 5"),
    RecoveredPage(5, 5, 7, Loss.BODY, "its code does not converge", margin_bits=-0.3, failed_blocks=3, iterations=25.0),
    RecoveredPage(6, 6, 7, Loss.BODY, "its code does not converge", margin_bits=-0.1, failed_blocks=1, iterations=11.0),
]
WHOLE = Recovery(
    code=CODE,
    volume=VOLUME,
    pages=(
        *(replace(READ, page=page, number=page) for page in range(4)),
        *LOST,
        replace(READ, page=7, volume=9, healed_rounds=2),
    ),
    restored=(3,),
    lost=(),
    missing=(3, 5, 6),
    foreign={9: 1},
    repeated=1,
    user_bytes_per_page=1000,
    symbols_per_page=2300,
    data_symbols_per_page=2200,
    blocks_per_page=BLOCKS,
)
NOTHING = replace(WHOLE, volume=None, pages=tuple(LOST), restored=(), missing=(), foreign={}, repeated=0)
BODY = NOTHING.to_json()["page_results"][1]


def written(recovery: Recovery, path: Path, **changes: Any) -> Path:
    write_json(path, recovery.to_json() | changes)
    return path


def facts_of(recovery: Recovery, folder: Path) -> dict[str, str]:
    return dict(report_of_recovery(JsonFile.read(written(recovery, folder / "r.json"))).facts)


def labels(picture: str) -> set[str]:
    """All text of a picture, an SVG as a data URI; matplotlib names the words that it draws in comments."""
    return set(re.findall(r"<!-- (.+?) -->", base64.b64decode(picture.partition(",")[2]).decode()))


def test_a_recovery(tmp_path: Path) -> None:
    text, seen = page_of(written(WHOLE, tmp_path / "r.json"), tmp_path / "r.html")
    check_whole(text, seen, SECTIONS)
    margin, failed = seen.pictures["pages"]
    assert {"read (5)", "optics (1)", "body (2)"} <= labels(margin)
    assert {"page lost (2)", "not decoded (1)"} <= labels(failed)
    for page in LOST:
        assert html.escape(page.reason) in text


def test_the_facts_of_a_recovery_and_its_losses_by_cause(tmp_path: Path) -> None:
    figures, facts = WHOLE.to_json(), facts_of(WHOLE, tmp_path)
    told = {
        "Volume": "10 pages in groups of 4 data and 2 parity",
        "Unread": "3",
        "Pages of other volumes": "1 of volume 9",
        "Missing": "3, 5-6",
        "Healed": "7",
        "Restored": "3",
        "AIR bytes a page": "880",  # 3.2 bits of 2200 symbols
        "Share of the AIR": "1.136",
        "Q, q": "3.478",
        "Page failure rate": f"{figures['page_failure_rate_bound_95']:.4f}",
        "Margin of pages that were read": "0.200",
        "Corrected": "10",
        "Time": "0.520",
    }
    assert {name: value for name, value in told.items() if value not in facts[name]} == {}
    data = report_of_recovery(JsonFile.read(tmp_path / "r.json"))
    found = [(cause, count, share) for cause, _, count, share in data.causes]
    assert found == [("optics", 1, 1 / 8), ("body", 2, 0.25)]
    assert set(LOSSES) == set(Loss)


def test_a_recovery_of_nothing(tmp_path: Path) -> None:
    _, seen = page_of(written(NOTHING, tmp_path / "r.json"), tmp_path / "r.html")
    assert {"read (0)", "optics (1)"} <= labels(seen.pictures["pages"][0])
    assert facts_of(NOTHING, tmp_path)["Page failure rate"].startswith("1.0000")
    none = {"page_results": [], "pages": 0, "pages_unread": 0, "page_failure_rate": None, "seconds_per_page": None}
    text, seen = page_of(written(NOTHING, tmp_path / "r.json", **none), tmp_path / "r.html")
    check_whole(text, seen, SECTIONS[:-1])
    assert not seen.pictures
    lacking = replace(WHOLE, pages=WHOLE.pages[:3], missing=(3,))
    text, seen = page_of(written(lacking, tmp_path / "r.json"), tmp_path / "r.html")
    assert len(seen.pictures["pages"]) == 1
    assert "but some were not recorded" in text


def test_long_lists_end_and_text_is_escaped(tmp_path: Path) -> None:
    evil = '<script>alert("1")</script>'
    lost = tuple(replace(LOST[1], page=page, number=page, reason=evil + 900 * "very long ") for page in range(2500))
    many = replace(WHOLE, pages=lost, missing=tuple(range(0, 5000, 2)))
    text, seen = page_of(written(many, tmp_path / "r.json"), tmp_path / "r.html")
    assert text.count("<td>body</td>") == 200 + 1  # one of them counts the cause
    assert all(picture.startswith("data:image/png") for picture in seen.pictures["pages"])
    assert "script" not in seen.tags
    assert html.escape(evil).replace("&quot;", "&#34;") in text


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"user_bytes_per_page": "1000"}, "user_bytes_per_page"),
        ({"air_bytes_per_page": float("inf")}, "air_bytes_per_page"),
        ({"code": CODE.model_dump() | {"levels": 17}}, "code"),
        ({"page_results": [BODY | {"loss": "<b>"}], "pages": 1, "pages_unread": 1}, r"page_results\.0\.loss"),
        ({"page_results": [BODY | {"failed_blocks": BLOCKS + 1}], "pages": 1, "pages_unread": 1}, "file"),
        ({"pages": 9}, "file"),
    ],
)
def test_figures_that_cannot_be_are_refused(changes: dict[str, Any], named: str, tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text(json.dumps(WHOLE.to_json() | changes))
    with pytest.raises(InvalidInputError, match=rf"r\.json: got {named} "):
        run(report, path, "--out", tmp_path / "r.html")
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (json.dumps({"target": "127.0.0.1:50051", "levels": 256, "pages": [], "refused_pages": []}), "decode"),
        ("[1, 2]", "no object"),
        ("[" * 100_000, "no JSON"),
    ],
)
def test_other_json_is_named(content: str, named: str, tmp_path: Path) -> None:
    (path := tmp_path / "j.json").write_text(content)
    with pytest.raises(InvalidInputError, match=named):
        run(report, path, "--out", tmp_path / "r.html")
