"""A golden page in few counts: what a camera could have shown, in little room, and never where it shows no page."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.recording.exposure import check_light
from lightpage.recording.frame_pair import FramePair
from runtime.bundle.bundle import npz
from runtime.bundle.golden import in_few_counts, shows_page


def noisy(bit_depth: int, shape: tuple[int, int] = (301, 200)) -> FramePair:
    """Frames of all counts, a twentieth of them at full scale."""
    top, rng = (1 << bit_depth) - 1, np.random.default_rng(0)
    dtype = np.uint8 if bit_depth == 8 else np.uint16
    frames = [np.clip(rng.normal(top / 2, top / 3.3, shape), 0, top).astype(dtype) for _ in range(2)]
    return FramePair(*frames)


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
def test_it_takes_less_room_and_its_light_is_the_pages(bit_depth: int) -> None:
    pair, step = noisy(bit_depth), (1 << bit_depth) // 32
    coarse = in_few_counts(pair, bit_depth)
    for own, few in ((pair.in_phase, coarse.in_phase), (pair.quadrature, coarse.quadrature)):
        assert (few.dtype, few.shape) == (own.dtype, own.shape)
        assert len(np.unique(few)) <= 32
        check_light("frame", few, bit_depth)
        blocks = own[:300].astype(float).reshape(150, 2, 100, 2).mean((1, 3))
        assert np.abs(few[:300:2, ::2] - blocks).max() <= step / 2 + 1
        assert few.mean() == pytest.approx(own.mean(), rel=0.01)
    assert len(npz(a=coarse.in_phase)) < len(npz(a=pair.in_phase)) / 2


def test_frames_at_full_scale_and_black_ones_stay_within_a_cameras_counts() -> None:
    bright = np.full((4, 6), 4095, np.uint16)
    coarse = in_few_counts(FramePair(bright, np.zeros_like(bright)), 12)
    assert (int(coarse.in_phase.max()), int(coarse.quadrature.max())) == (4095 - 63, 64)


@pytest.mark.parametrize(("coarse", "shows"), [(0.0014, True), (0.0019, False), (float("nan"), False)])
def test_it_must_stay_clear_of_the_limit(coarse: float, shows: bool) -> None:
    assert shows_page(coarse, 0.001, 0.003) is shows
