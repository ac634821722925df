"""The comparison of speeds: every decoder runs on the same frames, and the table says so."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from analysis.speed.parts import Machine, lines
from analysis.speed.speed import FIRST_LOOK, frames_of, main, makers, profiled
from export.onnx_files import decoder_onnx
from tests.lightpage.small import small_profile


def test_decoders_take_turns_and_are_compared_with_the_first(tmp_path: Path) -> None:
    profile, figures = tmp_path / "small.toml", tmp_path / "F.json"
    profile.write_text(small_profile().to_toml())
    chosen = ["--decoder", "ray 16/32", "--decoder", "coherent"]
    asked = ["--profile", str(profile), *chosen, "--repeats", "2", "--threads", "1", "--json", str(figures)]
    output = CliRunner().invoke(main, asked, catch_exceptions=False, standalone_mode=False).output
    ray, coherent = json.loads(figures.read_text())["decoders"]
    assert (coherent["decoder"], ray["ratio"], ray["decoder"]) == ("coherent", 1.0, "ray 16/32")
    assert coherent["ratio"] == pytest.approx(coherent["seconds"] / ray["seconds"])
    assert ray["parameters"] > 200_000
    assert "ray 16/32" in output
    parts = json.loads(figures.read_text())["parts"]
    names = [part["name"] for part in parts["coherent"]]
    assert names == ["field", "sampling", "network", "answers"]
    network = parts["coherent"][names.index("network")]
    profile_of = small_profile()
    channels, light, pixels = FIRST_LOOK.channels, 2 * 5 * 16, profile_of.page.rows * profile_of.page.columns
    convolutions = 9 * (light * channels + 2 * 2 * channels * channels) + 3 * channels
    assert network["flops"] == pytest.approx(2 * pixels * convolutions, rel=0.05)
    assert all(part["seconds"] > 0 and part["floor_s"] > 0 for part in parts["coherent"])


@pytest.mark.long
def test_a_second_pass_has_parts_of_its_own() -> None:
    profile = small_profile()
    graph, tensors = makers(profile)["refined"]()
    model = decoder_onnx(graph.eval(), "uint8", profile.frame_shape, tensors)
    found = profiled(model, frames_of(profile), 1, Machine(1e11, 1e10))
    assert [part.name for part in found if part.name.startswith("second pass")] == [
        "second pass, to camera: pipe",
        "second pass, to page: pipe",
        "second pass: lenses, innovation",
        "second pass: network",
    ]
    assert len(lines(found)) == len(found) + 2


def test_the_choice_of_decoders_is_checked() -> None:
    with pytest.raises(click.BadParameter, match="coherent, refined, fast, wave"):
        CliRunner().invoke(main, ["--decoder", "x"], catch_exceptions=False, standalone_mode=False)


def test_every_decoder_that_is_named_can_be_made() -> None:
    for name, make in makers(small_profile()).items():
        graph, tensors = make()
        assert tensors, name
        assert graph.outputs[0] == "p"
