"""An exported run says what torch says, carries its table as a default, and fails loudly where it does not."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from lightpage.calibration.parameters import NAMES, nominal
from lightpage.calibration.sampling_table import APART, apart_inputs, sampling_table
from lightpage.device.state import Device
from lightpage.errors import BundleError, InvalidInputError
from lightpage.export import from_run, run_graph
from lightpage.export.commands.export import export
from lightpage.export.from_run import export_run
from lightpage.export.graph import TABLE_INPUTS, FieldGraph, angle
from lightpage.export.onnx_files import field_onnx
from lightpage.export.operators.check import fallbacks, page_part
from lightpage.export.operators.operator_list import PROVIDERS
from lightpage.export.parity import check_parity
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.commands.archives.evaluate import evaluate
from lightpage.runtime.model.bundle.bundle import Bundle, in_few_counts, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import DECODER, FIELD, TWIN
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.field_solver import BundleFieldSolver
from lightpage.runtime.model.execution.session import open_session
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.runs import GOLDEN, REFERENCES, WEIGHTS, load_run
from lightpage.waves.grid import field_grid
from tests.lightpage.command import run
from tests.lightpage.small import UNEXPLAINED, small_profile


@pytest.fixture(scope="module")
def decoder(small_bundle: Path) -> Decoder:
    return Decoder.load(small_bundle)


@pytest.fixture(scope="module")
def exported(decoder: Decoder) -> Bundle:
    return decoder.bundle


@pytest.fixture
def frame_types(exported: Bundle, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let exports take the graphs of an earlier one, to save time; return the frame types that they ask for."""
    files, asked = exported.files, []

    def ready(name: str) -> Callable[..., bytes]:
        def graph(_: object, *more: object) -> bytes:
            asked.extend(str(value) for value in more[:1])
            return files[name]

        return graph

    for function, name in (("decoder_onnx", DECODER), ("field_onnx", FIELD), ("twin_onnx", TWIN)):
        monkeypatch.setattr(from_run, function, ready(name))
    return asked


def test_eight_bit_counts_that_came_in_sixteen_bits_make_an_eight_bit_bundle(
    small_run: Path, tmp_path: Path, frame_types: list[str]
) -> None:
    wide = tmp_path / "run"
    shutil.copytree(small_run, wide)
    for name in (GOLDEN, REFERENCES):
        with np.load(wide / name) as kept:
            arrays = dict(kept)
        for key in ("in_phase", "quadrature"):
            arrays[key] = arrays[key].astype(">u2")
        np.savez(wide / name, **arrays)
    bundle, error = export_run(wide, tmp_path / "wide.zip")
    assert bundle.manifest.frame_dtype == "uint8"
    assert frame_types == ["uint8", "uint8"]
    assert error <= 1e-3


def test_the_golden_page_is_the_runs_own_in_few_counts(exported: Bundle, decoder: Decoder, small_run: Path) -> None:
    bundle = exported
    with np.load(small_run / GOLDEN) as kept:
        page = FramePair(kept["in_phase"], kept["quadrature"])
    np.testing.assert_array_equal(bundle.golden.pair.in_phase, in_few_counts(page, 8).in_phase)
    assert len(bundle.files["golden.npz"]) < len(npz(in_phase=page.in_phase, quadrature=page.quadrature)) / 3
    own, coarse = decoder.infer(page), decoder.infer(bundle.golden.pair)
    limit = bundle.manifest.residual_limit
    assert limit is not None
    assert 0 < own.residual < coarse.residual < limit
    together = np.vdot(own.p, coarse.p) / np.linalg.norm(own.p) / np.linalg.norm(coarse.p)
    assert together > 0.9


def test_the_fields_own_graph_shows_the_decoders_field(
    exported: Bundle, decoder: Decoder, small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = exported
    files = {name: data for name, data in bundle.files.items() if name != FIELD}
    without = Decoder.load(write_bundle(tmp_path / "without.zip", bundle.manifest, files))
    table = sampling_table(TorchTwin(RayTwin(small_profile())), nominal(), np.pi / 2, small_profile())
    with np.load(small_run / REFERENCES) as kept:
        references = FramePair(kept["in_phase"], kept["quadrature"])
    asked = bundle.golden.pair, references, table["registration"], table["homodyne"], {}
    field, left = decoder.field_solver(*asked)
    expected, expected_left = without.field_solver(*asked)
    assert np.sqrt(np.mean(np.abs(expected) ** 2)) > 0.1  # of the light that a symbol of full modulation brings
    assert np.max(expected_left) > 1e-3
    np.testing.assert_allclose(field, expected, atol=1e-4)
    np.testing.assert_allclose(left, expected_left, atol=1e-4)
    # as a decoder that looks at the field more coarsely would have it
    monkeypatch.setattr("lightpage.runtime.model.decoding.field_solver.field_grid", partial(field_grid, step_px=3))
    with pytest.raises(BundleError, match="output field"):
        without.field_solver(*asked)


@pytest.mark.parametrize("tilt_rad", [0.0, -0.4])
def test_a_fields_graph_takes_the_defocus_of_cameras_that_stand_apart(
    tilt_rad: float, exported: Bundle, small_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lightpage.train.models.field.ROUNDS_APART", 2)  # of many alike
    profile, parameters, pair = small_profile(), nominal(), exported.golden.pair
    parameters[[NAMES.index(f"{camera}_axial_rad") for camera in ("in_phase", "quadrature")]] = 0.8, -0.7
    parameters[NAMES.index("cameras_apart_x_rad")] = tilt_rad
    apart = apart_inputs(parameters)
    assert apart == (APART if tilt_rad else APART[:1])
    table = sampling_table(TorchTwin(RayTwin(profile)), parameters, np.pi / 2, profile)
    with np.load(small_run / REFERENCES) as kept:
        references = FramePair(kept["in_phase"], kept["quadrature"])
    tensors = {"reference_in_phase": references.in_phase, "reference_quadrature": references.quadrature, **table}
    files = exported.files | {FIELD: field_onnx(FieldGraph(profile, apart=apart), "uint8", tensors)}
    graph = Mock(ports=(*TABLE_INPUTS, *apart), value=table.__getitem__)
    own, torchs = BundleFieldSolver(replace(exported, files=files), graph, 1), TorchFieldSolver(FieldRecovery(profile))
    fields = []
    for names, most in ((apart, 1e-5), (APART[:1], 1e-5), ((), 0.1)):  # torch descends for cameras in one plane
        asked = pair, references, table["registration"], table["homodyne"], {name: table[name] for name in names}
        (field, _), (expected, _) = own(*asked), torchs(*asked)
        assert np.linalg.norm(field - expected) < most * np.linalg.norm(expected)
        fields.append(field)
    assert np.abs(fields[0] - fields[1 if tilt_rad else 2]).max() > 0.1


def test_the_table_is_a_default_that_another_replaces(decoder: Decoder) -> None:
    golden = decoder.bundle.golden
    plain = decoder.infer(golden.pair).p
    phases = decoder.graph.ports["phases"].shape
    other = decoder.with_table({"phases": np.zeros([n or 1 for n in phases], dtype=np.float32)})
    fed = other.infer(golden.pair).p
    assert set(decoder.graph.ports) >= {*TABLE_INPUTS, "positions", "places", "place_gradients", "phases"}
    assert np.linalg.norm(fed - plain) > 0.01 * np.linalg.norm(plain)


def test_the_twin_in_the_bundle_traces_as_torch_does(exported: Bundle) -> None:
    bundle = exported
    session = open_session(bundle.files["twin.onnx"], "twin", 1)
    parameters = true_parameters(bundle.profile, Device())
    points = np.random.default_rng(0).uniform(-5e-4, 5e-4, (17, 2))
    names = ["places", "phases", "positions", "pixels"]
    places, phases, positions, pixels = session.run(
        names, {"parameters": parameters, "points": points, "anchors": points, "camera_places": points[:4]}
    )
    twin = TorchTwin(RayTwin(bundle.profile))
    rays = twin.trace(parameters, points)
    np.testing.assert_allclose(places, rays.places, atol=1e-12)
    np.testing.assert_allclose(phases, rays.phases, atol=1e-3)
    np.testing.assert_allclose(positions, rays.positions, atol=1e-6)
    np.testing.assert_allclose(pixels, twin.pixels(parameters, points[:4]), atol=1e-3)


def test_a_graph_that_differs_from_torch_leaves_no_bundle(
    small_run: Path, tmp_path: Path, frame_types: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = run_graph.torch_answer

    def off(*arguments: object) -> dict[str, np.ndarray]:
        outputs = answer(*arguments)  # type: ignore[arg-type]
        return {**outputs, "p": outputs["p"] * 1.01}

    monkeypatch.setattr(run_graph, "torch_answer", off)
    with pytest.raises(BundleError, match=r"0\.0099"):
        export_run(small_run, tmp_path / "bad.zip")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_export_leaves_nothing_and_works_again(
    small_run: Path, tmp_path: Path, frame_types: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(path: Path) -> None:
        assert path.exists()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Decoder, "load", interrupted)
        with pytest.raises(KeyboardInterrupt):
            export_run(small_run, tmp_path / "small.zip")
    assert list(tmp_path.iterdir()) == []
    run(export, small_run, "--out", tmp_path / "small.zip", "--json", tmp_path / "F")
    figures = json.loads((tmp_path / "F").read_text())
    assert 0 < figures["parity_error"] <= 1e-3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["F", "small.zip"]


@pytest.mark.parametrize("name", [GOLDEN, REFERENCES, WEIGHTS])
def test_a_run_file_that_was_cut_off_is_named(small_run: Path, tmp_path: Path, name: str) -> None:
    cut = tmp_path / "run"
    shutil.copytree(small_run, cut)
    for size in (0, 100):
        (cut / name).write_bytes((small_run / name).read_bytes()[:size])
        with pytest.raises(InvalidInputError, match=name):
            export_run(cut, tmp_path / "n.zip")


def test_a_run_with_a_wrong_fit_is_not_exported_unasked(small_run: Path, tmp_path: Path) -> None:
    folder, given = tmp_path / "run", load_run(small_run)
    folder.mkdir()
    wrong = given.calibration.model_copy(update={"goodness": UNEXPLAINED})
    replace(given, calibration_toml=wrong.to_toml()).save(folder)
    for words, message in (((), "wrong fit"), (("--accept-wrong-fit",), "arrays")):
        result = CliRunner().invoke(export, [str(folder), "--out", str(tmp_path / "b.zip"), *words])
        assert message in str(result.exception)


def test_parity_is_judged_against_the_norm_and_never_passes_nan() -> None:
    p = np.ones((2, 3, 4), dtype=np.float32)
    assert check_parity(p, p * (1 + 5e-4), "x") == pytest.approx(5e-4, rel=1e-2)
    for wrong in (p * 1.002, p * np.nan):
        with pytest.raises(BundleError, match="parity"):
            check_parity(p, wrong, "x")


def test_the_angle_is_the_arc_tangent_in_every_octant() -> None:
    turns = torch.linspace(-np.pi, np.pi, 10_001, dtype=torch.float64)
    for length in (1e-12, 1.0, 1e6):
        x, y = ((length * part(turns)).to(torch.float32) for part in (torch.cos, torch.sin))
        assert (angle(x, y) - torch.atan2(y, x)).abs().max() < 3e-7
    dark = torch.zeros(3)
    assert (angle(dark, dark) == 0).all()
    assert angle(torch.full((1,), torch.nan), dark[:1]).isnan().all()


@pytest.mark.usefixtures("frame_types")
def test_half_precision_reads_as_much_and_stays_on_the_provider(
    small_run: Path, small_bundle: Path, small_device: list[str], tmp_path: Path
) -> None:
    half = tmp_path / "half.zip"
    run(export, small_run, "--out", half, "--precision", "float16", "--recording", small_device[3])
    for provider in PROVIDERS:
        assert fallbacks(page_part(Bundle.open(half).files[DECODER]), provider) == [], provider
    rates = []
    for bundle in (small_bundle, half):
        run(evaluate, "--bundle", bundle, "--recording", small_device[3], "--json", tmp_path / "E.json")
        rates.append(json.loads((tmp_path / "E.json").read_text())["air_bits_per_symbol"])
    # as calibrated concentrations read the run's validation pages; a dozen pilots show the piston
    assert rates[0] > load_run(small_run).validation_air - 0.6 > 1
    assert abs(rates[1] - rates[0]) < 0.01
