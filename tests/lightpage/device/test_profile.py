"""Profiles: shipped ones load, every kind of bad profile is refused and names the key, TOML survives a round trip."""

import hashlib
import re
from pathlib import Path

import pytest

from lightpage.device.profile import SHIPPED, load_profile, parse_profile
from lightpage.device.profile_keys import commented_toml, keys
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


def test_a_name_of_any_characters_survives_it_too(tmp_path: Path) -> None:
    profile = load_profile("bench").model_copy(update={"name": 'a "quoted\\"\n\t\x7f\x07Ger\u00e4t \U0001f4bd'})
    (tmp_path / "mine.toml").write_text(profile.to_toml(), "utf-8")
    assert load_profile(tmp_path / "mine.toml") == profile


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("wavelength_m = 5.32e-07", "wavelength_m = nan", "light.wavelength_m"),
        ("length_m = 0.01875", "length_m = 0.0", "pipe.length_m"),
        ("angle_deg = 0.0", "angle_deg = 5.1", "pipe.angle_deg"),
        ("refractive_index = 1.461", "refractive_index = 0.9", "pipe.refractive_index"),
        ("rows = 56", "rows = 0", "page.rows"),
        ("rows = 56", 'rows = "56"', "page.rows"),
        ("angle_deg = 0.0", "angle_deg = true", "pipe.angle_deg"),
        ("wavelength_m = 5.32e-07", "wavelength_m = 0.532", "light.wavelength_m = 0.532 (wanted at most 0.0001 m)"),
        ("focal_length_m = 0.02", "focal_length_m = 20", "lens.focal_length_m"),
        ("pilot_fraction = 0.01", "pilot_fraction = 0.5", "page.pilot_fraction"),
        ("schema_version = 1", "schema_version = 2", "schema_version"),
        ("pitch_m = 9.2e-06\n", "", "slm.pitch_m"),
        ("[light]", "[light]\ncolour = 1", "light.colour"),
        ("columns = 87", "columns = 100000", "page.columns"),
        ("length_m = 0.01875", "length_m = 9.0", "pipe.length_m, pipe.width_m"),
        ("angle_deg = 0.0", "angel_deg = 0.0", "did you mean angle_deg?"),
        ("[light]", "[relay]\nmagnification = 0.0\n\n[light]", "relay.magnification"),
        (
            "[pipe]",
            "camera_focal_length_m = 0.04\n\n[lens_path]\ncoma_rad = 1.0\n\n[pipe]",
            "lens.camera_focal_length_m",
        ),
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


@pytest.mark.parametrize("name", SHIPPED)
def test_a_profile_to_fill_in_has_every_key_and_is_the_same(name: str) -> None:
    text = commented_toml(load_profile(name))
    assert parse_profile(text) == load_profile(name)
    for key in keys():
        assert re.search(rf"^(# )?{key.name} = ?.*# .*: {key.meaning}$", text, re.MULTILINE), key


def test_earlier_profiles_keep_their_text_and_hash() -> None:
    hashes = [hashlib.sha256(load_profile(name).to_toml().encode()).hexdigest()[:8] for name in SHIPPED]
    assert hashes == ["5be7b504", "3cbeffd1"]


@pytest.mark.parametrize(
    ("text", "got"), [("", "no name"), ("a = [", "TOML"), ("trigger = 1\nin_phase = 1", "cameras")]
)
def test_text_that_is_no_profile_is_refused(text: str, got: str) -> None:
    with refused("profile", got, kind=ProfileError):
        parse_profile(text)


def test_a_missing_file_and_an_unreadable_one_are_refused(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "none.toml", binary):
        with refused(str(path), kind=ProfileError):
            load_profile(path)
