"""Pages that `lightpage report` makes, and what a browser would see in them."""

import re
from html.parser import HTMLParser
from pathlib import Path

from lightpage.report.command import report
from tests.lightpage.command import run


class Seen(HTMLParser):
    """Parser of a page: its sections, its pictures, and everything that a browser would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.pictures: dict[str, list[str]] = {}
        self.fetched: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.tags.add(tag)
        if tag == "section":
            self.sections.append(given["id"])
        if tag == "img":
            assert given["alt"]
            self.pictures.setdefault(self.sections[-1], []).append(given["src"])
        self.fetched += [given[name] for name in ("src", "href", "srcset", "data", "action") if name in given]


def page_of(source: Path, out: Path, *more: object) -> tuple[str, Seen]:
    run(report, source, "--out", out, *more)
    text = out.read_text()
    return text, Seen(text)


def check_whole(text: str, seen: Seen, sections: list[str]) -> None:
    """Every section is there, and the page asks nobody for anything."""
    assert seen.sections == sections
    assert all(where.startswith(("data:image/", "#")) for where in seen.fetched)
    assert not seen.tags & {"script", "link", "iframe", "object"}
    assert not re.search(r"https?://|url\(|@import", text)
