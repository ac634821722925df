import json
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner, Result

from analysis.results.measurements import Measurement, kept_measurements
from analysis.results.page import PAGE, ROOT, Results, main, render, with_table
from lightpage.codec.code import Code
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.metrics.provenance import PROVENANCE, Provenance
from lightpage.page.symbols import pilot_mask
from lightpage.run_files import BEGUN
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import bundle_path

README = {
    "published, ray localizer": "ray",
    "published, mode localizer": "mode",
    "Lightpage, `--preset fast`": "fast",
    "Lightpage, `--preset standard` (one pass)": "wave",
    "Lightpage, `--preset accurate` (two passes; the default)": "refined",
    "told the device's true state (oracle), two passes": "oracle-refined",
}
"""Methods by their names in the README's table."""
ORIGIN = {"command": "a command", "commit": "0123456", "machine": "a machine", "time": "2026", "inputs": {"a": "0"}}


def outcome(method: str, air: float, gained: float = 0.001) -> dict[str, Any]:
    curves = {"training_curve": [[1, 0.5]], "validation_curve": [[1, 0.4]]}
    return {"method": method, "air": air, "page_kB": air / 2, "steps": 1200, "gained_in_last_fifth": gained, **curves}


def toy(*outcomes: dict[str, Any], angle_deg: float = -0.6) -> dict[str, Any]:
    light = {"angle_deg": angle_deg, "full_well_e": 32.0, "exposure": 0.5, "symbol_size_px": 4, "ideal": False}
    return {"pages": 60, "seed": 1, "data_sets": [light | {"outcomes": list(outcomes)}]}


def written(path: Path, figures: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(figures))
    return path


def command(folder: Path, *options: object) -> Result:
    for name in ("kept", "results"):
        (folder / name).mkdir(exist_ok=True)
    own = ("--kept", folder / "kept", "--out", folder / "results" / "index.md")
    return CliRunner().invoke(main, [str(word) for word in (*own, *options)], catch_exceptions=False)


def test_the_page_is_what_the_kept_figures_make_it() -> None:
    results = Results(kept_measurements())
    assert render(results) == PAGE.read_text("utf-8"), "edited by hand, or `make results` not run"
    assert results.missing == []


def test_the_readme_says_what_the_kept_figures_say() -> None:
    kept, readme = kept_measurements(), (ROOT / "README.md").read_text("utf-8")
    told = [line.replace("*", "").strip("| ").split(" | ") for line in readme.splitlines() if line.count(" | ") == 2]
    told = [row for row in told if row[0] in README]
    found = [(name, Results(kept).outcome("sheared", -0.6, method)) for name, method in README.items()]
    assert told == [[name, f"{of['air']:.2f}", f"{of['page_kB']:.2f}"] for name, of in found if of is not None]
    waves = kept["waves-bench_-0.6deg_32e_1x_4px"].figures["rows"][-1]["air"]
    data = np.count_nonzero(~pilot_mask(load_profile("bench")))
    assert f"| Lightpage, fitted waves, no training | **{waves:.2f}** | **{waves * data / 8000:.2f}** |" in readme
    shipped = kept["evaluation"].figures["air_bits_per_symbol"]
    assert f"reads **{shipped:.2f} bits a symbol**" in " ".join(readme.split())
    ledger = kept["ledger"].figures
    dim, bright = ledger["32e"], ledger["bright"]
    assert f"**{dim['user_bytes_per_page']:,} user bytes a page**" in readme
    shares = f"{100 * dim['share_of_air']:.0f}% and {100 * bright['share_of_air']:.0f}% of their AIR"
    told = " ".join(readme.split())
    read = f"All {dim['pages'] + bright['pages']:,} pages were read"
    assert f"{bright['user_bytes_per_page']:,} in bright light. That is {shares}. {read}" in told
    large = [f"{ledger[f'full-size {size}']['user_bytes_per_page']:,} at {size}" for size in ("4x4", "2x2")]
    assert f"A full-size page holds {', '.join(large)} (4 of 4 read each)" in told
    assert dim["pages_unread"] == bright["pages_unread"] == 0


def test_kept_figures_say_where_they_are_from() -> None:
    configurations = {BEGUN, "mlserver-model.json", "mlserver-settings.json"}
    paths = [path for path in (ROOT / "analysis").rglob("*.json") if path.name not in configurations]
    assert paths
    for path in paths:
        found = Provenance.model_validate(json.loads(path.read_text("utf-8")).get(PROVENANCE, {}))
        assert not found.unknown or (found.command and found.commit and found.source), path
    adding_it = {"measurements.py", "kept_parts.py"}
    for path in (ROOT / "analysis").rglob("*.py"):
        assert path.name in adding_it or " write_json(" not in path.read_text("utf-8"), path


def test_the_table_of_tolerances_is_that_of_the_kept_figures() -> None:
    page = (ROOT / "docs" / "results" / "tolerances.md").read_text("utf-8")
    assert with_table(page, kept_measurements()["tolerances"].figures) == page


def test_the_ledger_is_that_of_the_shipped_code() -> None:
    shipped = Bundle.open(bundle_path("bench")).code
    assert shipped is not None
    # what the code needs is measured anew with every choice, and stands on no page
    assert Code(**kept_measurements()["ledger"].figures["bright"]["code"]).id == shipped.id


def test_figures_are_collected_without_their_curves_and_what_lacks_is_left_out(tmp_path: Path) -> None:
    figures = toy(outcome("ray", 2.344, gained=0.02), outcome("coherent", 4.5), outcome("refined 1", 5.0))
    path = written(tmp_path / "runs" / "sheared" / "figures.json", {PROVENANCE: ORIGIN, **figures})
    (tmp_path / "kept").mkdir()
    earlier = Measurement(toy(outcome("ray", 1.0)), Provenance(), "a caveat")
    earlier.write(tmp_path / "kept" / "sheared.json")
    done = command(tmp_path, "--from", tmp_path / "runs")
    assert done.exit_code == 0
    kept = kept_measurements(tmp_path / "kept")
    assert list(kept) == ["sheared"]
    assert (kept["sheared"].provenance.to_json(), kept["sheared"].note) == (ORIGIN, "")
    for one in figures["data_sets"][0]["outcomes"]:
        del one["training_curve"], one["validation_curve"]
    assert kept["sheared"].figures == figures
    assert (tmp_path / "images" / "decoders.png").stat().st_size > 10_000
    assert "| published, ray localizer | 2.34 | open | 1.17 |" in (tmp_path / "results" / "index.md").read_text()
    # a comparison that is not finished replaces nothing
    written(path, {PROVENANCE: ORIGIN, **toy(outcome("ray", 3.0))})
    command(tmp_path, "--from", tmp_path / "runs")
    assert kept_measurements(tmp_path / "kept")["sheared"].figures == figures


def test_figures_of_the_waves_stand_beside_the_bound_of_their_light(tmp_path: Path) -> None:
    bench = load_profile("bench")
    device = Device().with_settings(["sensor.full_well_e=32"]).model_dump(mode="json")
    light = {PROVENANCE: ORIGIN, "asked": {"profile": bench.to_toml(), "device": device}}
    bound = {**light, "bits": 5.0, "standard_error": 0.01, "concentrations": [[1.0]]}
    rows = [
        {"steps": steps, "air": air, "ece": 0.004, "over_claim": 0.0, "over_bound": None, "seconds": 1, "over_other": 1}
        for steps, air in ((1, 4.1), (2, 4.9))
    ]
    asked = {"--profile": bench.to_toml(), "device": device, "--pages": 24}
    waves = {PROVENANCE: ORIGIN, "asked": asked, "bound": None, "rows": rows}
    paths = [written(tmp_path / name, of) for name, of in (("bound.json", bound), ("waves.json", waves))]
    done = command(tmp_path, "--bound", paths[0], "--waves", paths[1])
    assert done.exit_code == 0
    page = (tmp_path / "results" / "index.md").read_text()
    assert "| bench, 4x4, 32 electrons | 24 | 4.10, 4.90 | 4.900 (2) | 0.980 | 0.0040 |" in page
    kept = kept_measurements(tmp_path / "kept")["waves-bench_-0.6deg_32e_1x_4px"].figures
    assert "seconds" not in kept["rows"][0]
