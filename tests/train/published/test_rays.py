"""Claims about the published ray tracer: another program's rays, single rays in numpy, closed forms, derivatives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lightpage.calibration.parameters import NAMES
from lightpage.device.lenses import LENSES, LensPrescription
from lightpage.device.profile import Profile, load_profile
from lightpage.errors import InvalidInputError
from lightpage.train.published.rays import RayTracer, Traced, _Rays, _through
from tests.lightpage.small import small_profile
from tests.train.models.test_twin import Ray, page_points
from tests.train.models.test_twin import follow as one_ray

ACHROMAT = LENSES["AC508-080-A"]
SLOPED = np.deg2rad(-0.6)

PARALLEL_MM: list[list[float]] = [[0, 0], [3.2, 0], [-4.4, 2.6], [6.4, 4.1], [12, -9]]
"""Heights of rays parallel to the axis, on the lens's front focal plane."""
FOCUSED_MM: list[list[float]] = [
    [0, 0],
    [-0.001394645739, 0],
    [0.004829076422, -0.002853545159],
    [-0.015109778538, -0.009679701876],
    [-0.088919473627, 0.066689605220],
]
"""Places that optiland 0.6.3 finds behind the achromat, on its back focal plane (traced once, written down here)."""
OBLIQUE_MM: list[list[float]] = [[0, 0], [1.1, -0.7], [-1.6, 1.3], [0.4, 1.7]]
OBLIQUE_SINES: list[list[float]] = [[0.06, 0.03], [-0.08, 0.05], [0.07, 0.06], [0.02, -0.05]]
LANDED_REVERSED_MM: list[list[float]] = [
    [4.799774430707, 2.399887215354],
    [-6.409396921134, 4.005937777329],
    [5.606800950923, 4.781807321474],
    [1.600919024354, -4.006142112707],
]
"""Places at which optiland finds rays that leave the front focal plane of the reversed achromat with those sines."""


def with_pipe(profile: Profile, **values: float) -> Profile:
    return profile.model_copy(update={"pipe": profile.pipe.model_copy(update=values)})


def scalar(angle: float) -> torch.Tensor:
    return torch.tensor(angle, dtype=torch.float64)


def trace(tracer: RayTracer, points: np.ndarray, angle: float = 0.0) -> Traced:
    traced: Traced = tracer(torch.tensor(points), scalar(angle))
    return traced


def path(tracer: RayTracer, points: np.ndarray, angle: float = 0.0) -> np.ndarray:
    return tracer.path(torch.tensor(points), scalar(angle)).numpy()


def follow(profile: Profile, angle: float, point: np.ndarray) -> Ray:
    """Trace a ray through the middle of the pipe's entrance."""
    values = dict.fromkeys(NAMES, 0.0) | {"pipe_angle_rad": angle - np.deg2rad(profile.pipe.angle_deg)}
    return one_ray(profile, values, point, np.zeros(2))


class TestLenses:
    @staticmethod
    def _landed_mm(lens: LensPrescription, heights_mm: list[list[float]], sines: list[list[float]]) -> np.ndarray:
        across, s = np.array(heights_mm) * 1e-3, np.array(sines)
        position = np.concatenate([across, np.zeros((len(s), 1))], axis=1)
        direction = np.concatenate([s, np.sqrt(1 - (s**2).sum(1, keepdims=True))], axis=1)
        rays = _Rays(torch.tensor(position), torch.tensor(direction), torch.ones(len(s), dtype=torch.bool))
        end = _through(lens, rays)[-1]
        assert end.valid.all()
        return end.position[:, :2].numpy() * 1e3

    def test_rays_land_where_another_program_has_them(self) -> None:
        level = [[0.0, 0.0]] * len(PARALLEL_MM)
        np.testing.assert_allclose(self._landed_mm(ACHROMAT, PARALLEL_MM, level), FOCUSED_MM, rtol=0, atol=1e-9)
        oblique = self._landed_mm(ACHROMAT.reversed(), OBLIQUE_MM, OBLIQUE_SINES)
        np.testing.assert_allclose(oblique, LANDED_REVERSED_MM, rtol=0, atol=1e-9)

    def test_behind_a_hyperboloid_all_rays_meet_in_one_point(self) -> None:
        # closed form: light parallel to the axis in glass of index n, which ends in a surface of conic -n^2
        index, radius = 1.5, 20e-3
        flat = replace(ACHROMAT.surfaces[0], radius_m=np.inf, thickness_m=10e-3, index=index)
        end = replace(flat, radius_m=-radius, thickness_m=0.0, index=1.0, conic=-(index**2))
        lens = replace(ACHROMAT, surfaces=(flat, end))
        landed = self._landed_mm(lens, [[2, 0], [5, -3], [-7, 8]], [[0.0, 0.0]] * 3)
        np.testing.assert_allclose(landed, 0, atol=1e-12)

    def test_the_image_of_the_axis_neighbourhood_is_the_page_itself(self) -> None:
        near = np.array([[10e-6, 0], [-7e-6, 4e-6]])
        places = trace(RayTracer(load_profile("paper"), ACHROMAT), near).places.numpy()
        np.testing.assert_allclose(places, near, rtol=1e-6, atol=1e-15)


def test_every_ray_goes_the_way_of_a_single_one() -> None:
    # seven times as long: a dozen walls, by turns
    paper, angle = load_profile("paper"), np.deg2rad(5)
    profile = with_pipe(paper, length_m=7.3 * paper.pipe.length_m)
    points, walls = page_points(profile, 100, seed=1), 0
    traced = trace(RayTracer(profile), points, angle)
    assert traced.valid.all()
    for index, point in enumerate(points):
        ray = follow(profile, angle, point)
        assert traced.reflections[index].tolist() == [ray.met.count("x"), ray.met.count("y")]
        assert np.abs(traced.places[index].numpy() - ray.direction).max() < 1e-12
        walls = max(walls, len(ray.met))
    assert walls >= 10


class TestLostRays:
    def test_in_a_sheared_pipe_single_rays_are_lost_alike(self) -> None:
        profile = with_pipe(small_profile(), refractive_index=1.0008)
        points = page_points(profile, 300, seed=2)
        expected = [not follow(profile, SLOPED, point).lost for point in points]
        assert 50 < sum(expected) < 250
        assert trace(RayTracer(profile), points, SLOPED).valid.tolist() == expected

    def test_the_stop_of_the_lens_and_missed_surfaces(self) -> None:
        narrow = replace(ACHROMAT, diameter_m=10e-3)
        heights = np.array([[4.99e-3, 0], [5.01e-3, 0], [3.54e-3, -3.54e-3]])
        first = path(RayTracer(load_profile("paper"), narrow), heights)[1]
        assert np.isfinite(first).all(-1).tolist() == [True, False, False]
        # 54.9 mm is the radius of the first surface: further out there is none
        tracer = RayTracer(load_profile("paper"), replace(ACHROMAT, diameter_m=1.0))
        heights = np.array([[1e-3, 0], [0, 54.5e-3], [0, 55e-3], [0.4, 0]])
        assert np.isfinite(path(tracer, heights)[1]).all(-1).tolist() == [True, True, False, False]
        traced = trace(tracer, heights)
        assert traced.valid.tolist() == [True, False, False, False]
        assert torch.isfinite(traced.places).all()


class TestInput:
    @pytest.mark.parametrize(
        ("points", "angle", "got"),
        [
            (torch.zeros(3, 2), scalar(0), "float32"),
            (torch.full((3, 2), torch.nan, dtype=torch.float64), scalar(0), "NaN"),
            (torch.zeros(3, 2, dtype=torch.float64), torch.zeros(1, dtype=torch.float64), r"\(1,\)"),
            (torch.zeros(3, 2, dtype=torch.float64), scalar(-0.6), r"-0\.6 rad"),
            (torch.zeros(3, 2, dtype=torch.float64), scalar(np.nan), "nan rad"),
        ],
    )
    def test_what_cannot_be_traced_is_refused(self, points: torch.Tensor, angle: torch.Tensor, got: str) -> None:
        tracer = RayTracer(small_profile())
        for trace in (tracer, tracer.path):
            with pytest.raises(InvalidInputError, match=got):
                trace(points, angle)

    def test_a_lens_that_spreads_light_is_refused(self) -> None:
        surfaces = tuple(replace(surface, radius_m=-surface.radius_m) for surface in ACHROMAT.surfaces)
        with pytest.raises(InvalidInputError, match="focal planes"):
            RayTracer(small_profile(), replace(ACHROMAT, surfaces=surfaces))
