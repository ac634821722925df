"""The site is built of the pages and of the code, and no link leads nowhere."""

import re

import pytest

from tests.release.scripts import ROOT, script

site = script("build_site")


def test_the_site_builds_and_its_links_lead_somewhere() -> None:
    assert site.main() == 0
    reference = site.SITE / "reference"
    assert "<Figure" not in (site.SITE / "notebooks" / "decode-a-recording.html").read_text("utf-8")
    for page, named in {
        "commands": "--refinements",
        "settings": "longest_wait_ms",
        "metrics": "lightpage_<wbr>margin_<wbr>bits",
        "camera-keys": "[trigger] and [modulator], kind = plugin",
        "calls": "DecodeFrames",
        "python": "ModelsClient.roll_back",
    }.items():
        assert named in (reference / f"{page}.html").read_text("utf-8")
    assert not [row for made in site.GENERATED.values() for row in made().splitlines() if row.endswith("|  |")]


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_pages_at_the_top_link_to_files_that_are_there(page: str) -> None:
    made = {f"docs/reference/{name}.md" for name in site.GENERATED}
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", (ROOT / page).read_text("utf-8"))
    assert not [link for link in links if link not in made and not (ROOT / link).exists()]
