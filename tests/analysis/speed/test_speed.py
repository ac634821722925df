"""Benchmarks of speed: each runs small and writes its figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner
from onnx import parser

from analysis.speed import footprint, provider, roofline, scaling, speed
from analysis.speed.fidelity import FORMS, HALF, measured, name_of
from analysis.speed.roofline import LAYOUT, POINTWISE, PRODUCTS, Gpu, Load
from lightpage.recording.reader import Recording
from runtime.decoding.decoder import Decoder
from tests.lightpage.small import small_profile
from tests.runtime import toy

GRAPH = """<ir_version: 10, opset_import: ["" : 20]>
decoder (float[8, 4] in_phase, float[4, 2] quadrature) => (float[2, 8] p)
<float[4, 2] weights = {1, 2, 3, 4, 5, 6, 7, 8}>
{
  both = Add(quadrature, weights)
  product = MatMul(in_phase, both)
  flat = Transpose<perm=[1, 0]>(product)
  p = Identity(flat)
}"""
SLOW = Gpu("slow", flops_per_s=128.0, half_flops_per_s=1280.0, bytes_per_s=64.0, bus_bytes_per_s=10.0, launch_s=0.5)


def figures(command: click.Command, folder: Path, *words: object) -> dict[str, Any]:
    """What a benchmark writes."""
    asked = [*map(str, words), "--json", str(folder / "F.json")]
    CliRunner().invoke(command, asked, catch_exceptions=False, standalone_mode=False)
    found: dict[str, Any] = json.loads((folder / "F.json").read_text())
    return found


@pytest.fixture
def small(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(small_profile().to_toml())
    return tmp_path / "small.toml"


def test_a_decoder_is_timed_part_by_part(small: Path, tmp_path: Path) -> None:
    found = figures(speed.main, tmp_path, "--profile", small, "--decoder", "coherent", "--repeats", 1, "--threads", 1)
    (coherent,) = found["decoders"]
    assert (coherent["decoder"], coherent["ratio"]) == ("coherent", 1.0)
    assert [part["name"] for part in found["parts"]["coherent"]] == ["field", "sampling", "network", "answers"]
    assert all(part["seconds"] > 0 and part["floor_s"] > 0 for part in found["parts"]["coherent"])


@pytest.mark.long  # exports two decoders to time them
def test_pages_grow_by_the_square_of_the_factor(small: Path, tmp_path: Path) -> None:
    found = figures(scaling.main, tmp_path, "--profile", small, "--factor", 1, "--factor", 2, "--repeats", 1)
    assert [page["symbols"] for page in found["pages"]] == [44 * 28, 4 * 44 * 28]


@pytest.mark.long  # exports a decoder and starts two processes
def test_every_file_of_a_bundle_is_weighed(small: Path, tmp_path: Path) -> None:
    asked = ("--profile", small, "--decoder", "fast", "--pages", 2, "--threads", 1)
    (bundle,) = figures(footprint.main, tmp_path, *asked)["bundles"]
    assert bundle["unpacked_bytes"] == sum(file["unpacked_bytes"] for file in bundle["files"])
    assert (len(bundle["loading"]["pages_s"]), len(bundle["decoding"]["pages_s"])) == (0, 2)
    assert bundle["loading"]["peak_bytes"] > 20e6


def test_a_provider_is_compared_with_the_cpu(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 1)
    asked = ("--bundle", toy.write_toy_bundle(tmp_path / "toy.zip"), "--recording", tmp_path / "r.h5")
    (made,) = figures(provider.main, tmp_path, *asked, "--precision", "float32", "--seconds", 0.05)["made"]
    assert (made["precision"], made["deviation"], made["symbols_changed"]) == ("float32", 0, 0)
    assert made["air"] > 4
    assert set(made["nodes"]) == {"CPUExecutionProvider"}


def test_forms_of_a_decoder_are_compared_with_the_usual_one(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 3)
    usual, doubtful = toy.decoder_onnx(), toy.decoder_onnx(kappa=100.0)
    decoder = Decoder.load(toy.write_toy_bundle(tmp_path / "toy.zip"))
    with Recording.open(tmp_path / "r.h5") as recording:
        models = {"usual": usual, "doubtful": doubtful}
        forms = {form.name: form for form in measured(decoder, models, doubtful, recording, 2, "usual")}
    assert forms["usual"].air > forms["doubtful"].air == forms[HALF].air > 4
    assert (forms["usual"].deviation, forms["doubtful"].deviation) == (0, pytest.approx(0.75, abs=1e-3))
    assert len({name_of(form) for form in FORMS}) == len(FORMS)


def test_flops_and_bytes_of_each_kind_of_node_and_the_slowest_of_work_launches_and_bus() -> None:
    found = roofline.loads(bytes(parser.parse_model(GRAPH).SerializeToString()), SLOW, share=0.5)
    # 8 x 2 numbers of 4 products each; 32 + 8 + 16 numbers moved take longer
    assert found == {
        POINTWISE: Load(1, 0.0, 96.0, 96 / 32),
        PRODUCTS: Load(1, 128.0, 224.0, 224 / 32),
        LAYOUT: Load(1, 0.0, 128.0, 4.0),
    }
    rate = roofline.estimate({POINTWISE: Load(3, 0.0, 0.0, 1.25)}, 40, SLOW)
    assert (rate["work_s"], rate["launches_s"], rate["bus_s"]) == (1.25, 1.5, 4.0)
    assert (rate["pages_per_s"], rate["bytes_per_s"]) == (0.25, 10.0)
