"""Claims about blemishes: dust and hot pixels are found on a reference, and a beam's own structure is none."""

import numpy as np
import pytest
import torch

from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.state import Device, Sensor
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pixels.blemishes import UNIT_GAIN, Blemishes
from lightpage.simulator.cameras import Blemishes as TrueBlemishes
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.models.field import FieldRecovery
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
DUSTY = Sensor(dust_specks=8, hot_pixel_share=3e-4)


def simulator(sensor: Sensor) -> Simulator:
    return Simulator(PROFILE, Device(sensor=sensor), seed=1)


def found(sensor: Sensor) -> Blemishes:
    return Blemishes.of(simulator(sensor).references())


@pytest.mark.parametrize("sensor", [Sensor(), Sensor(full_well_e=32), Sensor(bit_depth=12)], ids=str)
def test_a_clean_camera_has_none(sensor: Sensor) -> None:
    blemishes = found(sensor)
    assert blemishes.none
    pair = simulator(sensor).page(random_symbols(PROFILE, 256, 1, np.random.default_rng(0))[0])
    assert blemishes.corrected(pair) is pair


@pytest.mark.parametrize("sensor", [DUSTY, DUSTY.model_copy(update={"full_well_e": 200})], ids=["bright", "dim"])
def test_dust_is_divided_out_and_hot_pixels_have_no_signal(sensor: Sensor) -> None:
    blemishes = found(sensor)
    for which, gains in enumerate(blemishes.gains):
        true = TrueBlemishes.of(PROFILE.camera, sensor, which)
        passed = np.asarray(true.transmission)
        assert true.hot is not None
        assert not gains[true.hot].any()
        others = ~true.hot & (passed > 0.995)
        assert np.mean(gains[others] == 0) < 1e-4
        shaded = (passed < 0.9) & (gains > 0)
        left = passed[shaded] * gains[shaded] / UNIT_GAIN
        assert np.std(left) < 0.3 * np.std(passed[shaded])
        assert np.mean(left) == pytest.approx(1, abs=0.04)


def test_fringes_of_the_beam_are_no_dust() -> None:
    row, column = np.indices((400, 600))
    beam = 120 * (1 + 0.3 * np.cos(2 * np.pi * (column + 0.5 * row) / 17))
    frame = np.random.default_rng(0).poisson(beam).astype(np.uint8)
    assert Blemishes.of(FramePair(frame, frame)).none


def test_a_dark_corner_of_the_beam_is_no_dust() -> None:
    row, column = np.indices((400, 600))
    beam = 200 * np.exp(-((column - 300) ** 2 + (row - 200) ** 2) / 150**2)
    frame = np.random.default_rng(0).poisson(beam).astype(np.uint16)
    assert Blemishes.of(FramePair(frame, frame)).none


def test_the_graph_takes_off_what_is_mended_beforehand() -> None:
    simulated = simulator(DUSTY)
    references = simulated.references()
    blemishes = Blemishes.of(references)
    pair = simulated.page(random_symbols(PROFILE, 256, 1, np.random.default_rng(0))[0])
    device = perfectly_calibrated(PROFILE, simulated.device, references)
    traced = sampling_table(TorchTwin(RayTwin(PROFILE)), device.parameters, device.quadrature_phase_rad, PROFILE)
    recovery = FieldRecovery(PROFILE, rounds=0, corrected=True)
    clean = blemishes.references.in_phase, blemishes.references.quadrature
    blocks = recovery.in_blocks(*map(torch.from_numpy, clean))
    on_grid = recovery.references(blocks, torch.from_numpy(traced["registration"]))
    homodyne = torch.from_numpy(traced["homodyne"])

    def brightness(frames: FramePair, gains: np.ndarray | None) -> np.ndarray:
        tensors = torch.from_numpy(frames.in_phase), torch.from_numpy(frames.quadrature), homodyne
        chosen = None if gains is None else torch.from_numpy(gains)
        measured = recovery.measure_against(blocks, on_grid, *tensors, gains=chosen)
        return torch.stack([measured.a, measured.b]).numpy()

    mended = brightness(blemishes.corrected(pair), None)
    in_graph = brightness(pair, blemishes.gains)
    assert np.sqrt(np.mean((in_graph - mended) ** 2)) < 2e-3  # a mended count is rounded
    assert np.abs(brightness(pair, None) - mended).max() > 0.1


def test_places_of_blemishes_are_named() -> None:
    reference = np.random.default_rng(0).poisson(100, (200, 300)).astype(np.uint8)
    for column, row in ((40, 30), (250, 160)):
        reference[row, column] = 255
    row, column = np.indices(reference.shape)
    shadow = 1 - 0.6 * np.exp(-((column - 150) ** 2 + (row - 100) ** 2) / (2 * 3**2))
    clean = np.full(reference.shape, 100, np.uint8)
    in_phase, quadrature = Blemishes.of(FramePair(np.rint(reference * shadow).astype(np.uint8), clean)).places()
    assert in_phase.lost == [(40, 30), (250, 160)]
    ((x, y),) = in_phase.specks
    assert (x, y) == (pytest.approx(150, abs=1), pytest.approx(100, abs=1))
    assert all(place in str(in_phase) for place in ("(40, 30)", "(250, 160)"))
    assert not str(quadrature)
