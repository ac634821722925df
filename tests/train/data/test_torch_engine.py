"""The simulator in torch: the light of numpy's within the rounding of float32, noise of its own, clear refusals."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from lightpage.device.state import load_device
from lightpage.errors import InvalidInputError
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.cameras import resample
from lightpage.simulator.engine import NUMPY
from lightpage.simulator.light_bound import sampled_concentrations
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.data.torch_engine import TorchEngine, torch_device
from lightpage.train.models.decoder import LOCALIZERS
from lightpage.train.models.network import SymbolUNet
from lightpage.train.models.prediction import Prediction
from lightpage.train.trainers.refinement import refined_pages
from tests.lightpage.small import random_phases, small_profile

PROFILE = small_profile()
SETTINGS = (
    "slm.crosstalk_relative=0.02 slm.dead_pixel_share=1e-3 sensor.hot_pixel_share=1e-4 sensor.dust_specks=3 "
    "in_phase_camera.axial_rad=0.4 geometry.ghost_relative=0.01 sensor.bit_depth=12"
)
ROUGH = load_device("rough").with_settings(SETTINGS.split())
each_processor = pytest.mark.parametrize("compute", ["cpu", *["cuda"] * torch.cuda.is_available()])


@each_processor
def test_the_light_is_that_of_numpy_within_the_rounding_of_single_precision(compute: str) -> None:
    phase = np.kron(random_phases(PROFILE), np.ones((4, 4)))
    seen = []
    for engine in ({}, {"engine": TorchEngine(compute)}):
        optics = Simulator(PROFILE, ROUGH, seed=1, **engine).optics  # type: ignore[arg-type]
        leaving = optics.exit_field(optics.engine.array(phase), flicker_rad=0.01)
        field = optics.camera_field(leaving, ROUGH.in_phase_camera)
        view = optics.view(ROUGH.in_phase_camera, (1.2, -0.7))
        power = resample(abs(field) ** 2, *optics.camera_axes_m, *view, optics.engine)
        seen.append([optics.engine.to_numpy(part) for part in (leaving, field, power)])
    for plain, other in zip(*seen, strict=True):
        assert other.dtype.itemsize == plain.dtype.itemsize
        assert np.abs(other - plain).max() < 1e-5 * np.abs(plain).max()  # 32 steps, each of some roundings
    quiet = ROUGH.with_settings(["slm.phase_noise_rad=0"])
    bounds = [[*sampled_concentrations(PROFILE, quiet, 16, 3, (0, 1), e)] for e in (NUMPY, TorchEngine(compute))]
    assert bounds[1] == pytest.approx(bounds[0], rel=1e-4)


@each_processor
def test_pages_are_those_of_numpy_but_for_the_noise(compute: str) -> None:
    symbols = random_symbols(PROFILE, 256, 2, np.random.default_rng(0))
    plain = Simulator(PROFILE, ROUGH, seed=4)
    other, again = (Simulator(PROFILE, ROUGH, seed=4, engine=TorchEngine(compute)) for _ in range(2))
    again.skip(1)
    expected, found = ([simulator.simulate(page) for page in symbols] for simulator in (plain, other))
    assert [page.shift_px for page in found] == [page.shift_px for page in expected]
    np.testing.assert_array_equal(found[1].pair.quadrature, again.page(symbols[1]).quadrature)
    for name in ("in_phase", "quadrature"):
        one, two = (np.asarray(getattr(page[0].pair, name), float) for page in (expected, found))
        assert getattr(found[0].pair, name).dtype == np.uint16
        apart, correlation = one - two, np.corrcoef(one.ravel(), two.ravel())[0, 1]
        shot = 4095 / 15_000 * np.sqrt(one.mean() * 15_000 / 4095 + 2.5**2)
        assert abs(apart.mean()) < 5 * shot / np.sqrt(apart.size / 50)  # the page's own phase noise is common to many
        assert correlation > 0.95
        still = (getattr(simulator.references(), name).astype(int) for simulator in (plain, other))
        assert np.abs(np.subtract(*still)).max() <= 1  # half a count may round either way
        np.testing.assert_array_equal(*(getattr(simulator.dark(), name) for simulator in (plain, other)))


def test_a_page_is_made_on_one_device_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    meta = torch.device("meta")  # it computes nothing, and refuses tensors of others
    normal = lambda shape, dtype=None: torch.randn(shape, device=meta)  # noqa: E731
    monkeypatch.setattr("lightpage.train.data.torch_engine.torch_device", lambda _: meta)
    engine = TorchEngine("cuda")
    noise = SimpleNamespace(poisson=torch.poisson, standard_normal=normal)
    monkeypatch.setattr(engine, "generator", lambda _: noise)
    simulator = Simulator(PROFILE, ROUGH, engine=engine)
    simulator.optics.__dict__["signal_scale"] = 1.0  # a number that comes back
    seen = simulator.see(random_symbols(PROFILE, 256, 1, np.random.default_rng(0))[0])
    assert {part.device for part in (*seen.frames, seen.exit_field)} == {meta}
    assert [part.dtype for part in seen.frames] == [torch.uint16] * 2
    monkeypatch.setattr(torch.Tensor, "__float__", lambda _: 1.0)
    assert len([*sampled_concentrations(PROFILE, ROUGH, 256, 1, (0, 0), engine)]) == 1


@pytest.mark.parametrize("name", ["cuda", "cuda:0", "tpu", "cuda:x", "cpu:1", "", "cuda:2"])
def test_a_device_that_is_not_there_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    there = 2 if name == "cuda:2" else 0
    monkeypatch.setattr("torch.cuda.is_available", lambda: there > 0)
    monkeypatch.setattr("torch.cuda.device_count", lambda: there)
    assert not there or torch_device("cuda:1").index == 1
    with pytest.raises(InvalidInputError, match=f"--compute: got {name}"):
        torch_device(name)


@pytest.mark.parametrize("localizer", LOCALIZERS)
def test_features_are_computed_where_they_are_asked_for_alone(localizer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As above; what comes back to numpy is made up."""
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: torch.zeros(self.shape, dtype=self.dtype))
    device = perfectly_calibrated(PROFILE, ROUGH, FramePair(*np.full((2, *PROFILE.frame_shape), 9, np.uint16)))
    extractor = FeatureExtractor(device, localizer, compute=torch.device("meta"))
    page, _ = extractor.page(extractor.field(device.references), random_phases(PROFILE), np.zeros(2))
    assert page.light.shape[-2:] == PROFILE.page_shape
    shown = torch.from_numpy(page.light).flatten(0, 2), *map(torch.from_numpy, (page.positions, page.phases))
    earlier = MagicMock(__getitem__=lambda *_: shown, **{"state.return_value": page.state})
    inputs = MagicMock(pages=[0], **{"recording.frames.return_value": device.references})
    module = MagicMock(network=SymbolUNet(len(shown[0]), channels=4, blocks=1))
    prediction = Prediction(PROFILE, device.parameters, extractor.grid)
    (refined,) = refined_pages(extractor, prediction, inputs, earlier, module, 0, (0, 0))
    assert refined.light.shape[-2:] == PROFILE.page_shape
    assert {part.device.type for part in extractor.recovery.buffers()} == {"cpu"}
