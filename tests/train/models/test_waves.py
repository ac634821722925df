"""Both forms of the wave model in torch, for one page and for many, against the one in numpy, both ways."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from lightpage.calibration.parameters import NAMES, PRIORS
from lightpage.calibration.waves.wave_model import FittedWaves, on_modulator
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models import wave_lens, wave_pipe
from lightpage.train.models.batched.decoder import WaysBack, WaysThere
from lightpage.train.models.batched.products import PAD
from lightpage.train.models.batched.waves import BatchedWaves
from lightpage.train.models.parts import stacked
from lightpage.train.models.waves import EXACT, ROUGH, Banded, Fidelity, Waves
from tests.lightpage.small import THICK, small_profile

PROFILE = small_profile()
SAMPLES = 4
FINE = Fidelity(1e-3, 1e-3)
ERROR = 0.01
"""Error of that fidelity, and of light on sparse samples."""
ROUNDING = 1e-6
"""Error of an inner product by float32."""
Parameters = np.ndarray | None


@dataclass(frozen=True)
class Case:
    """Device and sampling.

    Attributes:
        shear_rad: shear of the pipe.
        filled: whether a sample of the modulator is a pixel, not a point.
        blur: variance of the modulator's blur, over the square of its pixels' pitch.
        tiles: about as many tiles along an axis.
        knocked: real lenses, and no parameter is zero: rolled pipe, tilted planes, all phases.
    """

    shear_rad: float
    filled: bool
    blur: float
    tiles: int = 1
    knocked: bool = False


CASES = {
    "real lenses, square": Case(0.0, filled=True, blur=0.0, knocked=True),
    "blurred points": Case(-0.01, filled=False, blur=2.0),
    "real lenses in tiles": Case(-0.01, filled=True, blur=2.0, tiles=3, knocked=True),
}


def device(shear_rad: float, *, knocked: bool = False, roll_rad: float | None = None) -> tuple[Profile, np.ndarray]:
    """A profile and parameters."""
    profile = PROFILE.model_copy(update={"lens_path": THICK}) if knocked else PROFILE
    parameters = true_parameters(profile, Device())
    if knocked:
        drawn = 0.5 * PRIORS * np.random.default_rng(3).standard_normal(len(NAMES))
        parameters = np.where(parameters == 0, drawn, parameters)
        assert np.all(parameters)
    parameters[NAMES.index("pipe_angle_rad")] = shear_rad
    if roll_rad is not None:
        parameters[NAMES.index("pipe_roll_rad")] = roll_rad
    return profile, parameters


class OnePage:
    """The form for one page."""

    def __init__(self, waves: Waves) -> None:
        self.waves = waves

    def to_camera(self, page: np.ndarray, parameters: Parameters = None, blur: float = 0.0) -> np.ndarray:
        return self._run(self.waves.to_camera, page, parameters, blur)

    def to_page(self, field: np.ndarray, parameters: Parameters = None, blur: float = 0.0) -> np.ndarray:
        return self._run(self.waves.to_page, field, parameters, blur)

    def _run(self, way: Callable[..., Tensor], light: np.ndarray, parameters: Parameters, blur: float) -> np.ndarray:
        at = self.waves.matrices(None if parameters is None else torch.from_numpy(parameters).float(), blur)
        return complex_of(way(at, stacked(light)))


class ManyPages:
    """The form for many pages: the page comes second in a batch, behind itself at half the amplitude."""

    def __init__(self, waves: Waves) -> None:
        self.waves, self.grid_shape = waves, (len(waves.grid_y_m), len(waves.grid_x_m))
        self.there, self.back = WaysThere(waves), WaysBack(waves)

    def to_camera(self, page: np.ndarray, parameters: Parameters = None, blur: float = 0.0) -> np.ndarray:
        tables = self._constants(self.there.tables, parameters, blur)
        real, imaginary = self.there.on_grid(self.there(batch_of(page), tables), tables)
        ny, nx = self.grid_shape
        return last_of(torch.stack([real, imaginary], 1)[..., :ny, :nx])

    def to_page(self, field: np.ndarray, parameters: Parameters = None, blur: float = 0.0) -> np.ndarray:
        tables = self._constants(self.back.tables, parameters, blur)
        padded = batch_of(np.pad(field, [(0, -count % PAD) for count in field.shape]))
        sparse = self.back.sparse((padded[:, 0], padded[:, 1]), tables)
        return last_of(self.back.waves.last.cropped(self.back.waves(sparse, tables)))

    def _constants(
        self, made: Callable[..., dict[str, Tensor]], parameters: Parameters, blur: float
    ) -> dict[str, Tensor]:
        given = self.waves.default if parameters is None else torch.from_numpy(parameters)
        return {name: value.float() for name, value in made(given, torch.tensor(blur)).items()}


Form = OnePage | ManyPages
FORMS = [OnePage, ManyPages]


def batch_of(light: np.ndarray) -> Tensor:
    return torch.stack([0.5 * stacked(light), stacked(light)])


def last_of(batch: Tensor) -> np.ndarray:
    """The second page of a batch, after a check of the first."""
    torch.testing.assert_close(2 * batch[0], batch[1], rtol=1e-3, atol=1e-3 * float(batch.abs().max()))
    return complex_of(batch[1])


def complex_of(light: Tensor) -> np.ndarray:
    return light[0].double().numpy() + 1j * light[1].double().numpy()


def noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def distance(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def symbol_phasors(profile: Profile) -> np.ndarray:
    return np.exp(2j * np.pi * np.random.default_rng(2).random(profile.page_shape))


@dataclass(frozen=True)
class Pair:
    """The model in numpy, and that in torch, of the same device."""

    case: Case
    fitted: FittedWaves
    waves: Waves


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def pair(request: pytest.FixtureRequest) -> Pair:
    case: Case = request.param
    profile, parameters = device(case.shear_rad, knocked=case.knocked)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wave_lens, "WAVES_A_TILE", wave_lens.WAVES_A_TILE / case.tiles**2)
        patch.setattr(wave_pipe, "MODES_A_BLOCK", 20 if case.tiles > 1 else wave_pipe.MODES_A_BLOCK)
        waves = Waves(profile, parameters, SAMPLES, FINE, filled=case.filled)
    assert any(name.endswith("blocks.1") for name, _ in waves.named_modules()) == (case.tiles > 1)
    return Pair(case, FittedWaves(profile, parameters, SAMPLES, filled=case.filled, blur=case.blur), waves)


@pytest.fixture(scope="module", params=FORMS)
def form(request: pytest.FixtureRequest, pair: Pair) -> Form:
    made: Form = request.param(pair.waves)
    return made


def test_a_page_lights_the_camera_as_in_the_fitted_waves(pair: Pair, form: Form) -> None:
    page = noise(pair.fitted.launch.shape)
    assert distance(form.to_camera(page, blur=pair.case.blur), pair.fitted.to_camera(page)) < ERROR


def test_a_field_comes_back_to_the_page_as_in_the_fitted_waves(pair: Pair, form: Form) -> None:
    field = pair.fitted.to_camera(noise(pair.fitted.launch.shape))
    assert distance(form.to_page(field, blur=pair.case.blur), pair.fitted.to_page(field)) < ERROR


def test_the_way_back_is_the_adjoint(pair: Pair, form: Form) -> None:
    page = noise(pair.fitted.launch.shape)
    field = pair.fitted.to_camera(noise(pair.fitted.launch.shape, 1) + page)
    there, back = form.to_camera(page, blur=pair.case.blur), form.to_page(field, blur=pair.case.blur)
    # a block of modes drops what its rim has received, both ways
    error = 1e-4 if pair.case.tiles > 1 and isinstance(form, OnePage) else ROUNDING
    assert np.vdot(field, there) == pytest.approx(np.vdot(back, page), rel=error)


@pytest.mark.parametrize("make", FORMS)
def test_it_is_the_adjoint_too_in_an_odd_number_of_steps(make: type[Form]) -> None:
    waves = Waves(*device(-0.01, knocked=True), 1, EXACT, filled=True)
    assert BatchedWaves(waves, to_page=False).pipe.steps % 2
    form, page = make(waves), noise(waves.profile.page_shape)
    there = form.to_camera(page)
    assert np.vdot(there, there) == pytest.approx(np.vdot(form.to_page(there), page), rel=ROUNDING)


@cache
def followed(roll_deg: float) -> tuple[Profile, np.ndarray, np.ndarray, np.ndarray]:
    """A device with real lenses, its parameters, a page on its modulator, and what the fitted waves make of it."""
    profile, parameters = device(-0.01, roll_rad=float(np.deg2rad(roll_deg)))
    profile = profile.model_copy(update={"lens_path": THICK})
    page = on_modulator(symbol_phasors(profile), SAMPLES)
    return profile, parameters, page, FittedWaves(profile, parameters, SAMPLES, filled=True).to_camera(page)


@pytest.mark.parametrize("make", FORMS)
@pytest.mark.parametrize(("fidelity", "at_most", "roll_deg"), [(EXACT, 0.04, 0.4), (ROUGH, 0.12, -0.4)])
def test_light_is_followed_as_exactly_as_is_asked(
    make: type[Form], fidelity: Fidelity, at_most: float, roll_deg: float
) -> None:
    profile, parameters, page, expected = followed(roll_deg)
    form = make(Waves(profile, parameters, SAMPLES, fidelity, filled=True))
    assert distance(form.to_camera(page), expected) < at_most


@pytest.mark.parametrize("make", FORMS)
def test_one_filled_sample_stands_for_a_symbol(make: type[Form]) -> None:
    profile, parameters = device(-0.01)
    symbols = symbol_phasors(profile)
    expected = FittedWaves(profile, parameters, SAMPLES, filled=True).to_camera(on_modulator(symbols, SAMPLES))
    form = make(Waves(profile, parameters, 1, FINE, filled=True))
    # phases vary within the symbols of so small a page
    assert distance(form.to_camera(SAMPLES * symbols), expected) < 0.05


@pytest.mark.parametrize("make", FORMS)
def test_other_parameters_make_the_waves_of_the_device_that_has_drifted(make: type[Form]) -> None:
    parameters = true_parameters(PROFILE, Device())
    drifted = parameters + 0.02 * PRIORS
    drifted[NAMES.index("page_centre_y_m")] -= 0.02 * PRIORS[NAMES.index("page_centre_y_m")]  # it changes the sampling
    expected = FittedWaves(PROFILE, drifted, SAMPLES, filled=True)
    form = make(Waves(PROFILE, parameters, SAMPLES, FINE, filled=True))
    page = noise(expected.launch.shape)
    field = expected.to_camera(page)
    assert distance(form.to_camera(page), field) > 10 * ERROR
    assert distance(form.to_camera(page, drifted), field) < ERROR
    assert distance(form.to_page(field, drifted), expected.to_page(field)) < ERROR


def test_constants_for_many_pages_are_computed_in_float64() -> None:
    waves = Waves(*device(-0.01), 1, ROUGH, filled=True)
    tables = BatchedWaves(waves, to_page=True).tables(waves.default, torch.tensor(1.0))
    assert {value.dtype for value in tables.values()} == {torch.float64}


def test_a_banded_matrix_multiplies_as_a_full_one() -> None:
    rows, columns = np.meshgrid(np.arange(150), np.arange(90), indexing="ij")
    matrix = np.where(np.abs(0.6 * rows - columns) < 9, rows + columns, 0.0)
    light = torch.randn(2, 90, 7, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(Banded(matrix)(light), torch.from_numpy(matrix).float() @ light, rtol=1e-4, atol=1e-3)
