"""A decoder of two passes as a bundle: it follows a device that drifts, and the image."""

from pathlib import Path

import numpy as np
from scipy import ndimage

from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.state import Device
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import SHIFT, DriftModel
from lightpage.runtime.model.decoding.image_tracker import WIDEST, ImageTracker, tracker_for
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

DEVICE = Device()


def test_with_the_drifted_devices_table_it_decodes_the_drifted_device(small_bundle: Path) -> None:
    profile, decoder = small_profile(), Decoder.load(small_bundle)
    drifted = DEVICE.with_settings([f"geometry.pipe_angle_deg={DEVICE.geometry.pipe_angle_deg + 0.15}"])
    symbols = random_symbols(profile, 256, 1, np.random.default_rng(9))[0]
    pair = Simulator(profile, drifted, seed=9).page(symbols)
    twin, parameters = TorchTwin(RayTwin(profile)), true_parameters(profile, drifted)
    table = sampling_table(twin, parameters, drifted.homodyne.turn_rad, profile)
    own = {name: value for name, value in table.items() if name in decoder.graph.ports}
    mask = decoder.pilots(256).mask

    def air(decoder: Decoder) -> float:
        page = decoder.decode(pair, 256, pilots=Pilots.of_symbols(mask, symbols, 256))
        return measure(page.phase[~mask], page.concentration[~mask], symbols[~mask], 256).air_bits_per_symbol

    assert air(decoder.with_table(own)) > air(decoder) + 0.5


def test_the_image_is_followed(small_bundle: Path, small_device: list[str]) -> None:
    decoder = Decoder.load(small_bundle)
    assert isinstance(tracker_for(decoder), ImageTracker)
    with Recording.open(small_device[3]) as recording:
        pair, symbols = recording.frames(0), recording.symbols(0)
    assert symbols is not None
    # the page's own dozen pilots would show it to a tenth of a pixel
    mask = np.random.default_rng(0).random(symbols.shape) < 0.3
    known = Pilots.of_symbols(mask, symbols, 256)
    by = (0.0, 0.3)  # rows, columns
    moved = [np.rint(ndimage.shift(f.astype(float), by, mode="nearest")) for f in (pair.in_phase, pair.quadrature)]
    seen = decoder.infer(FramePair(*(frame.astype(np.uint8) for frame in moved)))
    model, prior = DriftModel.of_decoder(decoder, OnnxTwin(decoder.bundle)), np.diag(WIDEST**2)
    found, before = (model.estimate(page, 256, known, prior) for page in (seen, decoder.infer(pair)))
    assert found is not None
    assert before is not None
    np.testing.assert_allclose(found.drift[SHIFT] - before.drift[SHIFT], (0.3, 0.0), atol=0.06)
