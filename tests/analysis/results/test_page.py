from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from analysis.results.measurements import COMPARISONS, Measurement, collected, kept_measurements
from analysis.results.page import PAGE, ROOT, Results, kilobytes, main, render
from lightpage.errors import InvalidInputError
from runtime.bundle.bundle import Bundle
from runtime.bundle.shipped import bundle_path

README = {
    "published, ray localizer": "ray",
    "published, mode localizer": "mode",
    "Lightpage, `--preset fast`": "fast",
    "Lightpage, `--preset standard` (one pass)": "wave",
    "Lightpage, `--preset accurate` (two passes; the default)": "refined",
    "told the device's true state (oracle), two passes": "oracle-refined",
}
"""Methods by their names in the README's table."""


def outcome(method: str, air: float, gained: float = 0.001) -> dict[str, Any]:
    curves = {"training_curve": [[1, 0.5]], "validation_curve": [[1, 0.4]]}
    return {"arm": method, "air": air, "page_kB": air / 2, "steps": 1200, "gained_in_last_fifth": gained, **curves}


def toy(*outcomes: dict[str, Any], angle_deg: float = -0.6) -> dict[str, Any]:
    data_set = {"angle_deg": angle_deg, "full_well_e": 32.0, "exposure": 0.5, "outcomes": list(outcomes)}
    return {"pages": 60, "seed": 1, "lights": [data_set]}


def written(path: Path, figures: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(figures))
    return path


def command(folder: Path, *options: object) -> Result:
    (folder / "kept").mkdir(exist_ok=True)
    own = ("--kept", folder / "kept", "--out", folder / "page.md")
    return CliRunner().invoke(main, [str(word) for word in (*own, *options)], catch_exceptions=False)


# ---- what is committed ----------------------------------------------------------------------------------------------


def test_the_page_is_what_the_kept_figures_make_it() -> None:
    results = Results(kept_measurements())
    assert render(results) == PAGE.read_text("utf-8"), "edited by hand, or `make results` not run"
    assert results.missing == []


def test_the_readme_says_what_the_kept_figures_say() -> None:
    kept = kept_measurements()
    readme = (ROOT / "README.md").read_text("utf-8")
    told = [line.replace("*", "").strip("| ").split(" | ") for line in readme.splitlines() if line.count(" | ") == 2]
    told = [row for row in told if row[0] in README]
    found = [(name, Results(kept).outcome("sheared", -0.6, method)) for name, method in README.items()]
    assert told == [[name, f"{of['air']:.2f}", f"{of['page_kB']:.2f}"] for name, of in found if of is not None]
    shipped = kept["evaluation"].figures["air_bits_per_symbol"]
    assert f"148 pages and 4,800 steps read {shipped:.1f} bits" in readme
    ledger = kept["ledger"].figures
    dim, bright = ledger["32e"], ledger["bright"]
    assert f"**{dim['user_bytes_per_page']:,} user bytes a page**" in readme
    shares = f"{100 * dim['share_of_air']:.0f} and {100 * bright['share_of_air']:.0f}% of the AIR"
    told = " ".join(readme.split())
    assert f"{bright['user_bytes_per_page']:,} in bright light. That is {shares}" in told
    assert (
        f"{dim['pages']:,} of {dim['pages']:,} and {bright['pages']:,} of {bright['pages']:,} pages were read" in told
    )
    large = [f"{ledger[f'full-size {size}']['user_bytes_per_page']:,} at {size}" for size in ("4x4", "2x2")]
    assert f"A full-size page holds {', '.join(large)} (4 of 4 read each)" in told
    assert dim["pages_unread"] == bright["pages_unread"] == 0


def test_the_ledger_is_that_of_the_shipped_code() -> None:
    shipped = Bundle.open(bundle_path("bench")).code
    assert shipped is not None
    assert kept_measurements()["ledger"].figures["bright"]["code"] == shipped.model_dump()


def test_no_kept_figures_are_long_or_of_an_unknown_source() -> None:
    kept = kept_measurements()
    assert set(COMPARISONS) <= set(kept)
    known = re.compile(r"measured \d{4}-\d\d-\d\d on commit [0-9a-f]{7}|laboratory notebook, commit [0-9a-f]{7}")
    assert [name for name, measurement in kept.items() if not known.fullmatch(measurement.source)] == []
    assert [name for name, of in kept.items() if len(json.dumps(of.figures)) > 20_000] == []


# ---- collecting -----------------------------------------------------------------------------------------------------


def test_figures_are_collected_without_their_curves_and_what_lacks_is_left_out(tmp_path: Path) -> None:
    figures = toy(outcome("ray", 2.344, gained=0.02), outcome("coherent", 4.5), outcome("refined 1", 5.0))
    path = written(tmp_path / "runs" / "sheared" / "figures.json", figures)
    (path.parent / "figure.png").write_bytes(b"picture")
    os.utime(path, (1_700_000_000, 1_700_000_000))
    (tmp_path / "kept").mkdir()
    Measurement(toy(outcome("ray", 1.0)), "a document", "a caveat").write(tmp_path / "kept" / "sheared.json")
    done = command(tmp_path, "--from", tmp_path / "runs", "--commit", "0123456789abcdef")
    assert done.exit_code == 0
    kept = kept_measurements(tmp_path / "kept")
    assert list(kept) == ["sheared"]
    assert (kept["sheared"].source, kept["sheared"].note) == ("measured 2023-11-14 on commit 0123456", "")
    for one in figures["lights"][0]["outcomes"]:
        del one["training_curve"], one["validation_curve"]
    assert kept["sheared"].figures == figures
    assert (tmp_path / "images" / "decoders.png").read_bytes() == b"picture"
    page = (tmp_path / "page.md").read_text()
    assert "| published, ray localizer | 2.34 | 1.17 |" in page
    assert "mode localizer |" not in page
    told = done.output.splitlines()
    assert any("square/figures.json" in line for line in told)
    for lacking in ("sheared, -0.6 degree, mode", "full-size", "evaluation", "demo"):
        assert any(line.endswith(lacking) for line in told), lacking
    # a comparison that is not finished replaces nothing
    written(path, toy(outcome("ray", 3.0)))
    done = command(tmp_path, "--from", tmp_path / "runs", "--commit", "0123456")
    assert "unfinished" in done.output
    assert kept_measurements(tmp_path / "kept")["sheared"].figures == figures


def test_a_page_of_nothing_has_no_figures(tmp_path: Path) -> None:
    assert command(tmp_path).exit_code == 0
    page = (tmp_path / "page.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("|") and "---" not in line]
    assert len(rows) == 3  # the heads of tables
    assert not any(re.search(r"\d\.\d", row) for row in rows)


def test_the_other_benchmarks_are_collected_as_numbers(tmp_path: Path) -> None:
    evaluation = {"air_bits_per_symbol": 6.5, "page_kB": 3.914, "pages": 14, "maps": {"air": [[1.0]]}, "bundle": {}}
    drift = {"seed": 0, "pages": 6, "levels": 16, "recalibration": {"pages_used": 2}, "seconds": 1.0}
    drift["phases"] = [{"air_bits_per_symbol": air} for air in (6.0, 3.0, 5.7)]
    timed = [{"decoder": "coherent", "seconds": 0.5}, {"decoder": "wave", "seconds": 1.0}]
    times = {"profile": "bench", "threads": 2, "repeats": 3, "decoders": timed}
    given = {"evaluation": evaluation, "demo": drift, "speed": times}
    words = [f"--{name}={written(tmp_path / f'{name}.json', figures)}" for name, figures in given.items()]
    assert command(tmp_path, *words, "--commit", "0123456").exit_code == 0
    kept = kept_measurements(tmp_path / "kept")
    assert kept["evaluation"].figures == {"air_bits_per_symbol": 6.5, "page_kB": 3.914, "pages": 14}
    page = (tmp_path / "page.md").read_text()
    assert "| 6.50 bits a symbol, 3.91 kB a page |" in page
    assert "| 95.0% of the AIR before |" in page
    assert Results(kept).times("bench", "wave", "coherent") == 2


@pytest.mark.skipif(shutil.which("git") is None, reason="no git")
def test_figures_of_an_unknown_commit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    path = written(tmp_path / "figures.json", toy())
    with pytest.raises(InvalidInputError, match="checkout"):
        collected("dim", path)
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "measured"], check=True)
    commit = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    path.write_text(path.read_text())
    assert collected("dim", path).source.endswith(f" on commit {commit[:7]}")
    os.utime(path, (1_700_000_000, 1_700_000_000))
    with pytest.raises(InvalidInputError, match="younger"):
        collected("dim", path)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InvalidInputError, match="checkout"):
        collected("dim", path)


@pytest.mark.parametrize(("name", "figures"), [("dim", {"pages": 3}), ("demo", {}), ("speed-bench", {}), ("dim", [])])
def test_figures_of_another_benchmark_are_refused(name: str, figures: object, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError):
        collected(name, written(tmp_path / "F.json", figures), "0123456")


def test_a_file_without_a_source_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="source"):
        Measurement.read(written(tmp_path / "F.json", {"figures": {}}))


def test_large_pages_are_told_with_fewer_digits() -> None:
    assert [kilobytes(size) for size in (8.966, 19.994, 43.56, 159.4)] == ["8.97", "19.99", "43.6", "159"]
