"""Profiles: shipped ones load, every kind of bad profile is refused and names the key, TOML survives a round trip."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightpage.device.profile import SHIPPED, load_profile, parse_profile
from lightpage.errors import ProfileError
from tests.lightpage.refused import refused


@pytest.fixture
def bench_text() -> str:
    return load_profile("bench").to_toml()


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_profile_survives_the_round_trip_through_toml(name: str) -> None:
    profile = load_profile(name)
    assert profile.name == name
    assert parse_profile(profile.to_toml()) == profile


@pytest.mark.parametrize(
    "name", ['a "quoted\\"', "two\nlines", "tab\t", "delete\x7f", "bell\x07", "Ger\u00e4t \U0001f4bd"]
)
def test_a_name_of_any_characters_survives_it_too(name: str) -> None:
    profile = load_profile("bench").model_copy(update={"name": name})
    assert parse_profile(profile.to_toml()) == profile


def test_bench_is_the_paper_device_at_a_quarter_of_its_size() -> None:
    bench, paper = load_profile("bench"), load_profile("paper")
    for pair in (
        (bench.lens.focal_length_m, paper.lens.focal_length_m),
        (bench.pipe.length_m, paper.pipe.length_m),
        (bench.camera.columns_px, paper.camera.columns_px),
        (bench.camera.rows_px, paper.camera.rows_px),
    ):
        assert pair[0] == pytest.approx(pair[1] / 4)
    assert bench.pipe.width_m == pytest.approx(paper.pipe.width_m / 4, rel=2e-3)
    assert (bench.light, bench.slm) == (paper.light, paper.slm)
    assert (bench.page.rows, bench.page.columns, paper.page.rows, paper.page.columns) == (56, 87, 225, 350)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("wavelength_m = 5.32e-07", "wavelength_m = nan", "light.wavelength_m"),
        ("wavelength_m = 5.32e-07", "wavelength_m = inf", "light.wavelength_m"),
        ("focal_length_m = 0.02", "focal_length_m = -0.02", "lens.focal_length_m"),
        ("length_m = 0.01875", "length_m = 0.0", "pipe.length_m"),
        ("angle_deg = 0.0", "angle_deg = nan", "pipe.angle_deg"),
        ("angle_deg = 0.0", "angle_deg = 30.0", "pipe.angle_deg"),
        ("refractive_index = 1.461", "refractive_index = 0.9", "pipe.refractive_index"),
        ("refractive_index = 1.461", 'refractive_index = "glass"', "pipe.refractive_index"),
        ("rows = 56", "rows = 0", "page.rows"),
        ("rows = 56", "rows = 56.5", "page.rows"),
        ("pilot_fraction = 0.01", "pilot_fraction = 0.0", "page.pilot_fraction"),
        ("pilot_seed = 0", "pilot_seed = -1", "page.pilot_seed"),
        ("columns_px = 1368", "columns_px = -1368", "camera.columns_px"),
        ("columns_px = 1368", "columns_px = 1000000", "camera.columns_px"),
        ("schema_version = 1", "schema_version = 2", "schema_version"),
        ('name = "bench"', 'name = ""', "name"),
        ("pitch_m = 9.2e-06\n", "", "slm.pitch_m"),
        ("[light]", "[light]\ncolour = 1", "light.colour"),
        ("[light]", "[lamp]", "lamp"),
        ("[light]", "[lamp]", "light"),
        ("columns = 87", "columns = 100000", "page.columns"),
        ("length_m = 0.01875", "length_m = 1e300", "pipe.length_m"),
        ("length_m = 0.01875", "length_m = 50.0", "pipe.length_m, pipe.width_m"),
    ],
)
def test_a_bad_profile_is_refused_and_the_key_named(bench_text: str, old: str, new: str, key: str) -> None:
    assert bench_text.count(old) == 1
    with refused("my.toml", key, ProfileError):
        parse_profile(bench_text.replace(old, new), "my.toml")


def test_every_offending_key_is_named_at_once(bench_text: str) -> None:
    bad = bench_text.replace("wavelength_m = 5.32e-07", "wavelength_m = nan").replace("rows = 56", "rows = -1")
    for key in ("light.wavelength_m", "page.rows"):
        with refused(got=key, kind=ProfileError):
            parse_profile(bad)


@pytest.mark.parametrize("text", ["", "not = [toml", "\x00", "[light]\n[light]"])
def test_text_that_is_no_profile_is_refused(text: str) -> None:
    with pytest.raises(ProfileError):
        parse_profile(text)


def test_a_profile_loads_from_a_path(tmp_path: Path, bench_text: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(bench_text.replace('name = "bench"', 'name = "mine"'), "utf-8")
    assert load_profile(path).name == "mine"


def test_a_missing_file_an_unreadable_one_and_a_folder_are_refused(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "none.toml", binary, tmp_path):
        with refused(str(path), kind=ProfileError):
            load_profile(path)
