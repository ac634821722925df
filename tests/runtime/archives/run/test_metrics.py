"""Metrics of a bulk run: scraped while it works, and in a file after its end, as Prometheus would have them."""

import re
from pathlib import Path
from urllib.request import urlopen

import pytest
from prometheus_client.parser import text_string_to_metric_families

from lightpage.runtime.archives.run.task import Task
from tests.runtime.archives.archive import PAGES, RANGE, Archive, spoil_page


def values(text: str) -> dict[str, float]:
    """Every sample by name and labels, without those of the run and its part."""
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = ",".join(value for name, value in sorted(sample.labels.items()) if name not in ("run", "part"))
            found[f"{sample.name}{{{labels}}}"] = sample.value
    return found


def test_a_run_is_scraped_while_it_works_and_its_end_is_in_a_file(
    archive: Archive, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    spoil_page(archive.folder / "a.h5", 1)
    scraped: list[dict[str, float]] = []
    address = ""

    def scrape(task: Task) -> None:
        nonlocal address
        if found := re.search(r"metrics at (http://\S+)", capsys.readouterr().err):
            address = found[1]
        with urlopen(address, timeout=20) as reply:
            scraped.append(values(reply.read().decode()))

    archive.before_each = scrape
    file = tmp_path / "bulk.prom"
    status, _ = archive.run("decode", "--metrics", "127.0.0.1:0", "--metrics-file", str(file))
    assert (status, len(scraped)) == (2, 6)
    read = [each["lightpage_bulk_pages_total{read}"] for each in scraped]
    assert read == [0, RANGE - 1, 2 * RANGE - 1, PAGES - 1, PAGES - 1 + RANGE, PAGES - 1 + 2 * RANGE]
    assert [each["lightpage_bulk_job_pages_left{}"] for each in scraped[:3]] == [2 * PAGES, 11, 8]
    for each in scraped:
        assert each["lightpage_bulk_job_pages{}"] == 2 * PAGES
        assert (each["lightpage_bulk_ranges_in_flight{}"], each["lightpage_bulk_workers{}"]) == (1, 1)
        assert "lightpage_bulk_end_timestamp_seconds{}" not in each
    end = values(file.read_text())
    assert end["lightpage_bulk_pages_total{lost}"] == end["lightpage_bulk_pages_lost_total{BlackFrameError}"] == 1
    assert end["lightpage_bulk_job_pages_left{}"] == end["lightpage_bulk_ranges_in_flight{}"] == 0
    assert end["lightpage_bulk_page_seconds_count{}"] == 2 * PAGES
    seconds = sum(record.seconds for record in archive.records().values())
    assert end["lightpage_bulk_page_seconds_sum{}"] == pytest.approx(seconds)
    assert end["lightpage_bulk_read_bytes_total{}"] == sum(each.read_bytes for each in archive.records().values())
    finished = [record.finished_s for record in archive.records().values() if record.finished_s is not None]
    assert max(finished) <= end["lightpage_bulk_end_timestamp_seconds{}"]


def test_a_file_is_written_however_a_run_ends(archive: Archive, tmp_path: Path) -> None:
    def interrupt(task: Task) -> None:
        if len(archive.tasks) == 2:
            raise KeyboardInterrupt

    archive.before_each = interrupt
    assert archive.run("decode", "--metrics-file", str(tmp_path / "bulk.prom"))[0] == 130
    assert len(archive.records()) == 2
    assert values((tmp_path / "bulk.prom").read_text())["lightpage_bulk_job_pages_left{}"] == 2 * PAGES - 2 * RANGE
