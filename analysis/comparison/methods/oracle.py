"""The oracle: the wave adjoint with the true geometry, cameras and reference, on frames freed of the signal's power."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.page.symbols import symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.simulator.cameras import resample
from lightpage.simulator.true_optics import TrueOptics, perfectly_calibrated
from lightpage.train.data.features import FeatureExtractor, PageFeatures


def without_signal_power(
    pair: FramePair, exit_field: NDArray[np.complex64], shift_px: tuple[float, float], optics: TrueOptics
) -> FramePair:
    """The frames of a page with the counts that |E|^2 adds taken off, noise and quantisation left in, float32."""
    device = optics.device
    counts = optics.electrons_per_unit * (2**device.sensor.bit_depth - 1) / device.sensor.full_well_e
    frames = []
    for frame, pose, gain, blemishes in (
        (pair.in_phase, device.in_phase_camera, 1.0, optics.blemishes[0]),
        (pair.quadrature, device.quadrature_camera, device.homodyne.quadrature_gain, optics.blemishes[1]),
    ):
        power = np.abs(optics.camera_field(exit_field, pose)) ** 2
        seen = resample(power, *optics.camera_axes_m, *optics.view(pose, shift_px))
        frames.append((frame - gain * counts * blemishes.transmission * seen).astype(np.float32))
    return FramePair(*frames)


class Oracle:
    """Features of an oracle, which may know what the recording's `truth` says.

    Args:
        recording: recording of a simulated device, with its truth.
        profile: the nominal device.
        device: true state of the device.
    """

    def __init__(self, recording: Recording, profile: Profile, device: Device) -> None:
        self._recording, self._optics = recording, TrueOptics(profile, device)
        perfect = perfectly_calibrated(profile, device, recording.references())
        self._extractor = FeatureExtractor(perfect, "wave", with_signal_power=False)

    def pages(self, indices: Sequence[int], shift_px: tuple[float, float] = (0.0, 0.0)) -> Iterator[PageFeatures]:
        """Features of the given pages, in order; the shift is followed from page to page, from `shift_px` on."""
        shift = np.array(shift_px)
        with h5py.File(str(self._recording.path)) as file:
            truth = file["truth"]
            assert isinstance(truth, h5py.Group)
            for index in indices:
                pair, symbols = self._recording.frames(index), self._recording.symbols(index)
                assert symbols is not None
                moved = truth["shift_px"][index]
                plain = without_signal_power(pair, truth["exit_field"][index], (moved[0], moved[1]), self._optics)
                phases = self._extractor.device.modulation.phase(symbol_phases(symbols, self._recording.levels))
                features, shift = self._extractor.page(self._extractor.field(plain), phases, shift)
                yield features
