"""The published localizers: where they look, and what the mode localizer undoes."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import Device, Geometry
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.published.decoder import sample_pair
from lightpage.train.published.localizers import (
    TRACED_ANEW_RAD,
    Localizer,
    ModeLocalizer,
    NoLocalizer,
    RayLocalizer,
    page_places,
)
from lightpage.waves.channel import WaveChannel
from lightpage.waves.geometry import WaveGeometry, cells_for
from tests.lightpage.small import small_profile

SAMPLES = 4
Complex = NDArray[np.complexfloating]


def aligned(localizer: Localizer, profile: Profile) -> Localizer:
    """The localizer with the cameras' affine as the profile says."""
    camera = profile.camera
    extent = torch.tensor([camera.columns_px, camera.rows_px]) * camera.pitch_m
    with torch.no_grad():
        half = torch.tensor([profile.page_width_m, profile.page_height_m]) / extent
        localizer.registration.matrix.copy_(torch.diag(half).expand(2, 2, 2))
    return localizer


def test_without_a_localizer_samples_lie_where_the_page_would_be_imaged() -> None:
    profile = small_profile()
    grid = aligned(NoLocalizer(profile, SAMPLES), profile).grid()
    height, width = profile.frame_shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    frames = torch.from_numpy(np.stack([columns, rows]))[None]
    seen, level = sample_pair(frames, frames[0], grid, torch.zeros(1, 2))
    assert torch.equal(seen, level)
    first = (
        np.array([width - 1, height - 1])
        - np.array([profile.page_width_m, profile.page_height_m]) / profile.camera.pitch_m
    ) / 2 + profile.symbol_pitch_m / SAMPLES / profile.camera.pitch_m / 2
    assert seen[0, :, 0, 0].tolist() == pytest.approx(first.tolist(), abs=1e-3)


def test_a_page_that_moved_is_looked_at_where_it_went() -> None:
    profile = small_profile()
    grid = NoLocalizer(profile, SAMPLES).grid().detach()
    generator = torch.Generator().manual_seed(0)
    frames = torch.rand(1, 2, *profile.frame_shape, generator=generator)
    moved = torch.roll(frames, (3, -2), dims=(2, 3))  # three rows down, two columns to the left
    before, level = sample_pair(frames, frames[0], grid, torch.zeros(1, 2))
    after, _ = sample_pair(moved, frames[0], grid, torch.tensor([[-2.0, 3.0]]))
    inside = slice(8, -8)
    assert torch.allclose(before[..., inside, inside], after[..., inside, inside], atol=1e-4)
    assert torch.equal(before, level)


def seen_by_cameras(profile: Profile, angle_deg: float) -> tuple[Complex, Complex]:
    """A page's field, and that field behind the pipe, both at the samples of a localizer."""
    rows, columns = (count * SAMPLES for count in profile.page_shape)
    half = np.array([profile.page_width_m, profile.page_height_m]) / 2
    x = half[0] * page_places((rows, columns))[0, :, 0].numpy()
    y = half[1] * page_places((rows, columns))[:, 0, 1].numpy()
    pipe = profile.pipe
    geometry = WaveGeometry(
        wavelength_m=profile.light.wavelength_m,
        focal_length_m=profile.lens.focal_length_m,
        pipe_length_m=pipe.length_m,
        pipe_width_m=pipe.width_m,
        refractive_index=pipe.refractive_index,
        pipe_angle=float(np.deg2rad(angle_deg)),
    )
    cells = cells_for(geometry, x, y, half[0], half[1])
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, profile.page_shape)
    page = np.exp(1j * np.kron(phases, np.ones((SAMPLES, SAMPLES))))
    return page, WaveChannel(geometry, x, y, x, y, cells, steps=32).forward(page)


def alike(one: Complex, other: Complex) -> float:
    return float(abs(np.vdot(one, other)) / np.linalg.norm(one) / np.linalg.norm(other))


def told(localizer: ModeLocalizer, field: Complex) -> Complex:
    images = torch.from_numpy(np.stack([field.real, field.imag]).astype(np.float32))[None]
    real, imaginary = localizer(images)[0].detach().numpy()
    return np.asarray(real + 1j * imaginary)


def test_modes_undo_a_square_pipe_and_not_a_sheared_one() -> None:
    profile = small_profile()
    localizer = ModeLocalizer(profile, SAMPLES)
    page, square = seen_by_cameras(profile, 0.0)
    _, sheared = seen_by_cameras(profile, -1.0)
    band = alike(page, told(localizer, square))
    assert alike(page, square) < 0.6
    assert band > 0.85  # what the pipe does not carry, nobody gets back
    assert alike(page, told(localizer, sheared)) < band - 0.1


def test_modes_know_the_sign_of_the_quadrature() -> None:
    profile = small_profile()
    _, square = seen_by_cameras(profile, 0.0)
    right = told(ModeLocalizer(profile, SAMPLES), square)
    np.testing.assert_allclose(told(ModeLocalizer(profile, SAMPLES, -1), square.conj()), right, atol=1e-4)


def test_gradients_reach_the_cameras_of_every_localizer_and_the_angle_of_the_rays() -> None:
    profile = small_profile()
    frames = torch.rand(1, 2, *profile.frame_shape, generator=torch.Generator().manual_seed(2))
    for localizer in (NoLocalizer(profile, 4), ModeLocalizer(profile, 4), RayLocalizer(profile, 4, page_moves=True)):
        seen, _ = sample_pair(frames, frames[0], localizer.grid(), torch.zeros(1, 2))
        (localizer(seen) ** 3).sum().backward()
        for name, parameter in localizer.named_parameters():
            assert parameter.grad is not None, name
            assert torch.isfinite(parameter.grad).all(), name
            assert float(parameter.grad.abs().sum()) > 0, name


def test_rays_look_where_the_light_of_a_short_pipe_goes() -> None:
    profile = small_profile()
    short = profile.model_copy(update={"pipe": profile.pipe.model_copy(update={"length_m": 1e-6})})
    torch.testing.assert_close(RayLocalizer(short, 4).grid(), NoLocalizer(short, 4).grid(), atol=1e-5, rtol=0)
    folded, straight = RayLocalizer(profile, 4).grid(), NoLocalizer(profile, 4).grid()
    same = torch.isclose(folded, straight, atol=1e-4).all(-1).float().mean()
    assert 0.1 < float(same) < 0.9  # the zones in the middle, and no others


def test_a_ray_that_the_pipe_loses_is_looked_for_outside_of_the_frames() -> None:
    profile = small_profile()
    air = profile.model_copy(update={"pipe": profile.pipe.model_copy(update={"refractive_index": 1.0005})})
    reach = RayLocalizer(air, 4).grid().detach().abs().amax(-1)
    assert (reach > 5).any()
    assert (reach < 1).any()


class TracedAtEachStep(RayLocalizer):
    """Rays as they were published: traced, and differentiated through the trace, at every angle."""

    def grid(self) -> torch.Tensor:
        page = small_profile()
        half = torch.tensor([page.page_width_m, page.page_height_m], dtype=torch.float64) / 2
        entered = self.places if self.page is None else self.page(self.places.float()).double()
        traced = self.tracer((entered * half).reshape(-1, 2), self.angle.double())
        landed = torch.where(traced.valid[:, None], traced.places / half, 10.0)
        return torch.as_tensor(self.registration(landed.reshape(self.places.shape).float()))


@pytest.mark.parametrize(
    ("training", "page_moves", "others"),
    [(True, False, 2e-3), (True, True, 0.03), (False, False, 1e-6), (False, True, 1e-6)],
)
def test_rays_traced_now_and_then_land_as_those_of_each_step(training: bool, page_moves: bool, others: float) -> None:
    kinds, traces = (RayLocalizer, TracedAtEachStep), list[object]()
    rays, anew = (kind(small_profile(), SAMPLES, page_moves=page_moves) for kind in kinds)
    rays.tracer.register_forward_hook(lambda *_: traces.append(_))
    rays.train(training).grid()
    pixel, sample = 2 / max(small_profile().frame_shape), 2 / max(rays.places.shape)
    for share, off_px in ((0.9, 0.02 if training else 0.0), (1.1, 0.0)):
        for localizer in (rays, anew):
            if localizer.page is None:
                localizer.angle.data.fill_(share * TRACED_ANEW_RAD)
            else:
                localizer.page.offset.data.fill_(share * sample)
        apart = (rays.grid() - anew.grid()).detach().abs().amax(-1) / pixel
        assert float(apart.median()) <= off_px + 1e-3
        # rays at a zone's edge meet other walls
        assert float((apart > off_px + 1e-3).float().mean()) < (others if training and off_px else 1e-6)
    assert len(traces) == (2 if training else 3) * (3 if page_moves else 1)
    along = torch.randn(rays.grid().shape, generator=torch.Generator().manual_seed(3))
    for localizer in (rays, anew):
        (localizer.grid() * along).sum().backward()
    for name, parameter in rays.named_parameters():
        torch.testing.assert_close(parameter.grad, anew.get_parameter(name).grad, rtol=1e-3, atol=1e-3)


def test_walls_turn_a_page_beside_the_axis_over_and_rays_follow_it_where_its_place_is_known() -> None:
    profile, device = small_profile(), Device(geometry=Geometry(pipe_angle_deg=-2, pipe_roll_deg=0))
    rays = RayLocalizer(profile, 1, page_moves=True).eval()
    rays.registration.begin((1.0, 1.0))
    rays.angle.data.fill_(np.deg2rad(-2))
    half, twin = np.array([profile.page_width_m, profile.page_height_m]) / 2, TorchTwin(RayTwin(profile))
    points = rays.places.numpy().reshape(-1, 2) * half
    true = twin.trace(true_parameters(profile, device), points).places.reshape(-1, *profile.page_shape, 2) / half
    shift_px = device.geometry.page_shift_x_px, device.geometry.page_shift_y_px
    offset = torch.from_numpy(np.array(shift_px) * profile.slm.pitch_m / half)

    def followed() -> float:
        """Share of the symbols whose ray lands within a quarter of a symbol of a branch of the twin's."""
        apart = np.abs(true - rays.grid()[0].detach().numpy()) * half / profile.symbol_pitch_m
        return float((np.hypot(*np.moveaxis(apart, -1, 0)).min(0) < 0.25).mean())

    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):  # as each zone has it
        rays.registration.offset.data[:] = offset * torch.tensor(signs)
        assert followed() < 0.45
    rays.registration.offset.data[:] = 0
    rays.page.offset.data[:] = offset
    assert followed() > 0.99
