"""Claims about local measurements: a patch finds the shift, phase and slope put in, and knows light that is not its."""

import numpy as np
import pytest

from lightpage.calibration import patches as module
from lightpage.calibration.calibrate import SIGNIFICANT
from lightpage.calibration.parameters import nominal
from lightpage.calibration.patches import (
    Measurement,
    Patch,
    Sampler,
    measure,
    middle_patches,
    patch_edge,
    patches,
    search_window,
)
from lightpage.device.profile import Profile, load_profile
from lightpage.waves.grid import symbol_samples
from tests.lightpage.calibration.flat_twin import FlatTwin, Picture
from tests.lightpage.small import random_phases, small_profile

PROFILE = small_profile()
SYMBOLS = np.exp(1j * random_phases(PROFILE, 1))
PITCH = PROFILE.symbol_pitch_m
PIXEL = PROFILE.camera.pitch_m
MIDDLE = patches(PROFILE)[5]
FINE = PROFILE.with_symbols_of(2)


def look(
    sampler: Sampler,
    patch: Patch = MIDDLE,
    symbols: np.ndarray = SYMBOLS,
    reach_px: float = 12,
    step_px: float = 3,
    ramp: tuple[float, float] = (0.0, 0.0),
    profile: Profile = PROFILE,
    turned: bool = False,
) -> Measurement:
    twin, window = FlatTwin(profile, ramp, turned), search_window(reach_px * PIXEL, step_px * PIXEL)
    samples = symbol_samples(profile)
    return measure(sampler, twin, nominal(), profile, patch, symbols, ("direct",), window, samples)[0]


class TestCutting:
    @pytest.mark.parametrize("size_px", [1, 4, 16])
    def test_patches_cover_the_page_once(self, size_px: int) -> None:
        profile = PROFILE.with_symbols_of(size_px)
        seen = np.zeros(profile.page_shape, int)
        for patch in patches(profile):
            seen[patch.rows, patch.columns] += 1
        assert (seen == 1).all()

    def test_their_centres_are_those_of_their_symbols(self) -> None:
        rows, columns = PROFILE.page_shape
        x = (np.arange(columns) - (columns - 1) / 2) * PITCH
        y = (np.arange(rows) - (rows - 1) / 2) * PITCH
        for patch in patches(PROFILE):
            expected = (x[patch.columns].mean(), y[patch.rows].mean())
            assert patch.centre_m == pytest.approx(expected, abs=1e-12)

    @pytest.mark.parametrize(("size_px", "edge"), [(1, 40), (2, 20), (4, 10), (16, 10)])
    def test_they_hold_enough_symbols_and_enough_light(self, size_px: int, edge: int) -> None:
        profile = load_profile("paper").with_symbols_of(size_px)
        assert patch_edge(profile) == edge
        for patch in patches(profile):
            assert 0.8 * edge <= patch.rows.stop - patch.rows.start <= 1.2 * edge
            assert 0.8 * edge <= patch.columns.stop - patch.columns.start <= 1.2 * edge

    @pytest.mark.parametrize(
        ("columns", "rows", "count"), [(87, 56, 6), (60, 40, 8), (48, 32, 9), (44, 28, 6), (30, 30, 9), (20, 20, 4)]
    )
    def test_the_middle_is_widened_by_whole_rings_until_it_holds_enough(
        self, columns: int, rows: int, count: int
    ) -> None:
        page = PROFILE.page.model_copy(update={"columns": columns, "rows": rows})
        profile = PROFILE.model_copy(update={"page": page})
        everywhere = patches(profile)
        middle = middle_patches(profile, everywhere, 5)
        assert len(middle) == count
        assert len(middle) >= min(5, len(everywhere))
        assert np.abs(np.mean([patch.centre_m for patch in middle], axis=0)).max() < 0.5 * profile.symbol_pitch_m


class TestFinding:
    @pytest.mark.parametrize("shift_px", [(0.0, 0.0), (-7.9, 9.4)])
    def test_an_injected_shift_is_found(self, shift_px: tuple[float, float]) -> None:
        found = look(Picture(PROFILE, SYMBOLS, (shift_px[0] * PIXEL, shift_px[1] * PIXEL)))
        expected = np.array(MIDDLE.centre_m) / PIXEL + [341.5, 227.5]
        assert found.read_at == pytest.approx(np.stack([expected] * 2))
        assert found.pixels == pytest.approx(np.stack([expected + shift_px] * 2), abs=0.3)
        assert found.significance > 0.9 * found.symbols

    @pytest.mark.parametrize("slope", [(0.4, -0.25), (-1.6, 1.1)])
    def test_an_injected_slope_is_found(self, slope: tuple[float, float]) -> None:
        ramp = (slope[0] / PITCH, slope[1] / PITCH)
        found = look(Picture(PROFILE, SYMBOLS, ramp=ramp))
        # the peak over slopes is read by a parabola, which on slopes 0.3 rad a symbol apart errs by up to 0.02
        assert found.slope * PITCH == pytest.approx(slope, abs=0.025)
        assert found.significance > 0.85 * found.symbols

    def test_what_the_twin_already_says_is_added_back(self) -> None:
        ramp = (0.9 / PITCH, -0.6 / PITCH)
        found = look(Picture(PROFILE, SYMBOLS, ramp=ramp, piston=0.4), ramp=ramp)
        blind = look(Picture(PROFILE, SYMBOLS, ramp=ramp, piston=0.4))
        expected = np.array(MIDDLE.centre_m) @ ramp + 0.4
        assert np.exp(1j * found.phase) == pytest.approx(np.exp(1j * expected), abs=0.02)
        assert np.exp(1j * blind.phase) == pytest.approx(np.exp(1j * expected), abs=0.05)
        assert found.slope * PITCH == pytest.approx([0.9, -0.6], abs=0.01)
        assert found.significance > blind.significance

    def test_the_carrier_is_how_the_phase_changes_with_the_place_of_reading(self) -> None:
        """Light that leaves through one side of the facet carries a phase ramp on the camera plane."""
        picture, per_px = Picture(PROFILE, SYMBOLS), np.array([0.11, -0.07])

        def tilted(places: np.ndarray) -> np.ndarray:
            away = places - np.array(MIDDLE.centre_m)
            return picture(places) * np.exp(1j * (away / PIXEL) @ per_px)

        for turned in (False, True):
            by_camera = np.stack([per_px, -per_px if turned else per_px]) / 2
            assert look(tilted, turned=turned).carrier == pytest.approx(by_camera, abs=0.005)
        assert look(picture).carrier == pytest.approx(np.zeros((2, 2)), abs=0.0025)


class TestSignificance:
    def test_right_symbols_reach_their_number(self) -> None:
        for patch in patches(PROFILE):
            found = look(Picture(PROFILE, SYMBOLS), patch, reach_px=0)
            assert found.symbols == (patch.rows.stop - patch.rows.start) * (patch.columns.stop - patch.columns.start)
            assert 0.9 * found.symbols < found.significance <= found.symbols * (1 + 1e-5)

    def test_unrelated_symbols_have_about_one_when_nothing_is_searched(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "SLOPES", np.array([-1e-9, 0, 1e-9]))
        seen = self._unrelated(reach_px=0, pages=15)
        assert len(seen) == 180
        assert np.mean(seen) == pytest.approx(1, abs=5 / np.sqrt(len(seen)))

    @pytest.mark.parametrize(("reach_px", "pages", "mistaken"), [(2, 9, 0.01), (24, 4, 0.05)])
    @pytest.mark.parametrize(("profile", "samples"), [(PROFILE, 2), (FINE, 1)], ids=["4 px", "2 px"])
    def test_a_search_among_unrelated_symbols_rarely_passes_for_a_find(
        self, reach_px: float, pages: int, mistaken: float, profile: Profile, samples: int
    ) -> None:
        seen = self._unrelated(reach_px, pages, samples, profile)
        assert np.mean(np.array(seen) > SIGNIFICANT) <= mistaken
        # the best of many trials, so above one
        assert np.mean(seen) > 4

    def test_half_the_light_from_elsewhere_costs_significance(self) -> None:
        own, other = Picture(PROFILE, SYMBOLS), Picture(PROFILE, np.exp(1j * random_phases(PROFILE, 9)))
        mixed = look(lambda places: own(places) + other(places))
        assert 0.3 * mixed.symbols < mixed.significance < 0.7 * mixed.symbols

    @staticmethod
    def _unrelated(reach_px: float, pages: int, samples: int = 4, profile: Profile = PROFILE) -> list[float]:
        picture = Picture(profile, np.exp(1j * random_phases(profile, 1)))
        window = search_window(reach_px * PIXEL, 4 * PIXEL)
        found = []
        for page in range(pages):
            symbols = np.exp(1j * random_phases(profile, 100 + page))
            for patch in patches(profile):
                found += measure(
                    picture, FlatTwin(profile), nominal(), profile, patch, symbols, ("direct",), window, samples
                )
        return [m.significance for m in found]
