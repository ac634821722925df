"""The comparison of speeds: every decoder runs on the same frames, and the table says so."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from analysis.speed.speed import main, makers
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
    with pytest.raises(click.BadParameter, match="coherent, refined, fast, wave"):
        CliRunner().invoke(main, ["--decoder", "x"], catch_exceptions=False, standalone_mode=False)


def test_every_decoder_that_is_named_can_be_made() -> None:
    for name, make in makers(small_profile()).items():
        graph, tensors = make()
        assert tensors, name
        assert graph.outputs[0] == "p"
