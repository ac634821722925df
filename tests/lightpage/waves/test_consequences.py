"""Consequences of a profile: the same light whatever shows it to the cameras, and what to change otherwise."""

import numpy as np
import pytest

from lightpage.device.profile import Lens, Profile, Relay, load_profile
from lightpage.device.state import Device
from lightpage.errors import ProfileError
from lightpage.simulator.simulator import Simulator
from lightpage.waves.consequences import consequences
from lightpage.waves.grid import check_camera
from tests.lightpage.refused import refused
from tests.lightpage.small import small_profile


def changed(profile: Profile, table: str, **values: object) -> Profile:
    return profile.model_copy(update={table: getattr(profile, table).model_copy(update=values)})


FOCAL_M = small_profile().lens.focal_length_m


@pytest.mark.parametrize(
    "magnifying",
    [{"relay": Relay(magnification=2)}, {"lens": Lens(focal_length_m=FOCAL_M, camera_focal_length_m=2 * FOCAL_M)}],
)
def test_pixels_that_grow_with_the_image_see_the_same(magnifying: dict[str, object]) -> None:
    plain = small_profile()
    larger = changed(plain, "camera", pitch_m=2 * plain.camera.pitch_m).model_copy(update=magnifying)
    symbols = np.random.default_rng(0).integers(0, 256, plain.page_shape).astype(np.uint8)
    seen = [Simulator(profile, Device(), 256, 1).simulate(symbols).pair for profile in (plain, larger)]
    np.testing.assert_array_equal(seen[0].in_phase, seen[1].in_phase)
    assert consequences(larger).image_px == consequences(plain).image_px


def test_the_shipped_devices_are_as_their_documents_say() -> None:
    told = consequences(load_profile("paper"))
    assert (told.symbols, told.walls_met, told.refused, told.doubts) == (78_750, (1, 1), (), ())
    assert told.pixels_per_symbol == pytest.approx(4 * 9.2 / 2.4)
    assert told.carried == pytest.approx(3.5585e-3 / (532e-9 * 80e-3 / 36.8e-6))  # the paper's 1.16 mm for 4 x 4
    assert told.cost["accurate"].seconds == pytest.approx(3.41)


def test_doubts_say_what_to_change() -> None:
    short = changed(load_profile("bench"), "pipe", length_m=1e-3)
    assert any("pipe.length_m from" in doubt for doubt in consequences(short).doubts)


@pytest.mark.parametrize(("pitch", "remedy"), [(4e-6, "at least 1.338"), (1.2e-6, "at most 0.5")])
def test_the_relay_that_a_refused_camera_is_told_mends_it(pitch: float, remedy: str) -> None:
    wrong = changed(load_profile("bench"), "camera", pitch_m=pitch)
    with refused("camera", kind=ProfileError, wanted=remedy):
        check_camera(wrong)
    check_camera(changed(wrong, "relay", magnification=pitch / 2.4e-6))
