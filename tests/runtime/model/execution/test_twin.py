"""The exported twin answers as registration asks, in float64, and a foreign graph is refused."""

from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest

from lightpage.calibration.parameters import NAMES
from lightpage.errors import BundleError
from lightpage.runtime.model.bundle.bundle import Bundle, write_bundle
from lightpage.runtime.model.bundle.manifest import TWIN
from lightpage.runtime.model.execution.twin import OnnxTwin
from tests.runtime import toy

TWIN_TEXT = """
<ir_version: 9, opset_import: ["" : 18]>
twin (double[PARAMETERS] parameters, double[n, 2] points, double[n, 2] anchors, double[m, 2] camera_places)
  => (double[1, n, 2] places, double[1, n] phases, double[n, 2] positions, double[2, m, 2] pixels)
<int64[2] two = {0, 1}, int64 zero = {0}, int64[1] front = {0}>
{
  shift = Gather(parameters, two)
  moved = Add(points, shift)
  places = Unsqueeze(moved, front)
  x = Gather<axis = 1>(anchors, zero)
  phases = Unsqueeze(x, front)
  positions = Identity(points)
  seen = Add(camera_places, shift)
  one = Unsqueeze(seen, front)
  pixels = Concat<axis = 0>(one, one)
}"""


def twin_graph(parameters: int = len(NAMES), left_out: str = "") -> bytes:
    """Places are points plus the first two parameters, phases the anchors' x, pixels places of both cameras."""
    model = onnx.parser.parse_model(TWIN_TEXT.replace("PARAMETERS", str(parameters)))
    kept = [output for output in model.graph.output if output.name != left_out]
    del model.graph.output[:]
    model.graph.output.extend(kept)
    return bytes(model.SerializeToString())


def bundle_with(path: Path, graph: bytes) -> Bundle:
    return Bundle.open(write_bundle(path, toy.manifest(), toy.files() | {TWIN: graph}))


@pytest.mark.parametrize("count", [2, 50_001])  # threads share the many
def test_all_comes_back_to_the_last_digit(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    twin = OnnxTwin(bundle_with(tmp_path / "b.zip", twin_graph()))
    parameters, points = 1e-9 * np.eye(1, len(NAMES))[0], np.random.default_rng(0).normal(size=(count, 2))
    rays = twin.trace(parameters, points, points + 1.0)
    np.testing.assert_array_equal(rays.places[0], points + parameters[:2])
    np.testing.assert_array_equal(rays.phases[0], points[:, 0] + 1.0)
    np.testing.assert_array_equal(rays.positions, points)
    np.testing.assert_array_equal(twin.trace(parameters, points).phases[0], points[:, 0])
    np.testing.assert_array_equal(twin.pixels(parameters, points[:1])[1], points[:1] + parameters[:2])


def test_many_devices_at_once_are_each_device_by_itself(tmp_path: Path) -> None:
    twin = OnnxTwin(bundle_with(tmp_path / "b.zip", twin_graph()))
    devices, points = (np.random.default_rng(0).normal(size=size) for size in ((3, len(NAMES)), (5, 2)))
    together = twin.trace(devices, points)
    assert together.places.shape == (3, 1, 5, 2)
    for index, device in enumerate(devices):
        for part, alone in zip(together, twin.trace(device, points), strict=True):
            np.testing.assert_array_equal(part[index], alone)
        np.testing.assert_array_equal(twin.pixels(devices, points)[index], twin.pixels(device, points))


@pytest.mark.parametrize(
    ("graph", "complaint"),
    [
        (toy.decoder_onnx(), "inputs"),
        (twin_graph(parameters=len(NAMES) - 1), "parameters"),
        (twin_graph(left_out="pixels"), "no pixels"),
    ],
)
def test_a_foreign_graph_is_refused(tmp_path: Path, graph: bytes, complaint: str) -> None:
    with pytest.raises(BundleError, match=complaint):
        OnnxTwin(bundle_with(tmp_path / "b.zip", graph))
