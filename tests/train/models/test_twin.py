"""Claims about the ray twin: against single rays followed wall by wall, closed forms, and its own derivatives."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from lightpage.calibration.interfaces import BRANCHES
from lightpage.calibration.parameters import NAMES, PRIORS, nominal
from lightpage.device.profile import Profile, Relay
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import THICK, small_profile


def some_device(seed: int, scale: float = 0.5) -> np.ndarray:
    """A parameter vector off nominal everywhere, [P]."""
    return scale * PRIORS * np.random.default_rng(seed).standard_normal(len(PRIORS))


def only(**values: float) -> np.ndarray:
    """Nominal but for the named parameters."""
    return np.array([values.get(name, usual) for name, usual in zip(NAMES, nominal(), strict=True)])


def page_points(profile: Profile, count: int, seed: int = 0) -> np.ndarray:
    half = np.array([profile.page_width_m, profile.page_height_m]) / 2
    return np.random.default_rng(seed).uniform(-half, half, (count, 2))


@dataclass
class Ray:
    """Ray that has left the pipe: what it met, in order, its direction and phase, and whether it was lost."""

    met: str
    direction: np.ndarray
    phase: float
    lost: bool


def follow(profile: Profile, values: dict[str, float], point: np.ndarray, entry: np.ndarray) -> Ray:
    """Trace one ray from a point of the entrance facet through a prism of four walls and an exit plane.

    Knows nothing of cells and branches: of the planes ahead it takes the nearest, adds the optical path, reflects the
    direction, and turns the phase by pi. `entry` is a point of the facet in the prism's own (x, y'), over the width.
    """
    k0 = 2 * np.pi / profile.light.wavelength_m
    nk = profile.pipe.refractive_index * k0
    f = profile.lens.focal_length_m * (1 + values["focal_length_relative"])
    length = profile.pipe.length_m * (1 + values["pipe_length_relative"])
    w = profile.pipe.width_m * (1 + values["pipe_width_relative"])
    t, roll = np.deg2rad(profile.pipe.angle_deg) + values["pipe_angle_rad"], values["pipe_roll_rad"]
    rolled = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    normals = {"x": rolled @ [1, 0], "y": rolled @ [np.sin(t), np.cos(t)]}
    offsets = {"x": values["pipe_centre_x_m"], "y": values["pipe_centre_y_m"]}
    planes = [
        (name, np.append(sign * normals[name], 0.0), w / 2 + sign * offsets[name]) for name in "xy" for sign in (1, -1)
    ]
    planes.append(("end", np.array([0.0, 0.0, 1.0]), length))
    transverse = -(k0 / f) * (point + np.array([values["page_centre_x_m"], values["page_centre_y_m"]]))
    k = np.append(transverse, np.sqrt(nk**2 - transverse @ transverse))
    across = np.linalg.solve(np.stack([normals["x"], normals["y"]]), w * entry + np.array([offsets["x"], offsets["y"]]))
    at, met, lost = np.append(across, 0.0), "", False
    phase = k[:2] @ at[:2] - nk * length
    for _ in range(50):
        ahead = [((c - n @ at) / (n @ k), name, n) for name, n, c in planes if n @ k > 0]
        reach, name, normal = min(ahead, key=lambda hit: hit[0])
        phase += reach * nk**2  # |k| times the distance reach |k|
        at = at + reach * k
        if name == "end":
            return Ray(met, -(f / k0) * k[:2], phase - k[:2] @ at[:2], lost)
        met += name
        lost |= bool(normal @ k > np.sqrt(nk**2 - k0**2))  # steeper than the critical angle
        phase += np.pi
        k = k - 2 * (k @ normal) * normal
    raise AssertionError("the ray never left the pipe")


def branch_of(met: str) -> str | None:
    """Branch that a sequence of walls belongs to; None if the walls took turns more than once."""
    x_first, y_first = "x" * met.count("x") + "y" * met.count("y"), "y" * met.count("y") + "x" * met.count("x")
    odd = ("x" if met.count("x") % 2 else "") + ("y" if met.count("y") % 2 else "")
    if met == x_first:
        return odd or "direct"
    return "yx" if met == y_first and odd == "xy" else None


class TestAgainstSingleRays:
    @pytest.mark.parametrize("angle_deg", [-0.6, 0.0, 1.0])
    def test_every_ray_leaves_as_one_of_its_points_branches(self, angle_deg: float) -> None:
        profile = small_profile()
        parameters = some_device(1)
        # what the cameras and the lenses add is no business of the pipe's
        for index, name in enumerate(NAMES):
            if name.startswith(("launch", "camera")) or "axial" in name:
                parameters[index] = 0
        parameters[0] = np.deg2rad(angle_deg)
        values = dict(zip(NAMES, parameters, strict=True))
        points = page_points(profile, 300, seed=2)
        rays = TorchTwin(RayTwin(profile)).trace(parameters, points)
        rng, seen = np.random.default_rng(3), dict.fromkeys(BRANCHES, 0)
        for index, point in enumerate(points):
            for entry in rng.uniform(-0.5, 0.5, (4, 2)):
                ray = follow(profile, values, point, entry)
                if (branch := branch_of(ray.met)) is None:
                    continue
                seen[branch] += 1
                b = BRANCHES.index(branch)
                assert np.abs(rays.places[b, index] - ray.direction).max() < 1e-12
                turn = rays.phases[b, index] - ray.phase
                assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-6
        assert sum(seen.values()) > 0.95 * 1200
        assert min(seen.values()) > 30


class TestClosedForms:
    def test_a_long_square_pipe_unfolds(self) -> None:
        profile = small_profile()
        longer = profile.pipe.model_copy(update={"length_m": 7.3 * profile.pipe.length_m})
        profile = profile.model_copy(update={"pipe": longer})
        points, twin = page_points(profile, 400), TorchTwin(RayTwin(profile))
        rays = twin.trace(nominal(), points)
        k0, w = 2 * np.pi / profile.light.wavelength_m, profile.pipe.width_m
        nk = profile.pipe.refractive_index * k0
        k = -k0 / profile.lens.focal_length_m * points
        kz = np.sqrt(nk**2 - (k**2).sum(1))
        unfolded = k / kz[:, None] * profile.pipe.length_m / w
        assert np.abs(unfolded).max() > 8
        np.testing.assert_allclose(rays.positions, unfolded, rtol=1e-12, atol=1e-12)
        sheared = np.stack([unfolded[:, 0], unfolded @ [np.sin(0.01), np.cos(0.01)]], axis=-1)
        found = twin.trace(only(pipe_angle_rad=0.01), points).positions
        np.testing.assert_allclose(found, sheared, rtol=1e-12, atol=1e-12)
        even, odd = 2 * np.round(unfolded / 2), 2 * np.floor(unfolded / 2) + 1
        for b, branch in enumerate(BRANCHES):
            cell = np.stack([(odd if "x" in branch else even)[:, 0], (odd if "y" in branch else even)[:, 1]], axis=-1)
            # the cell's mirror image of the exit facet lies cell widths away, and each wall between turns by pi
            phase = (kz - nk) * profile.pipe.length_m + (k * cell).sum(1) * w + np.pi * np.abs(cell).sum(1)
            np.testing.assert_allclose(rays.phases[b], phase, rtol=0, atol=1e-6)
            np.testing.assert_allclose(rays.places[b], points * (-1) ** cell, rtol=0, atol=1e-15)


class TestPaths:
    def test_anchors_decide_the_cells_of_all_their_points(self) -> None:
        profile = small_profile()
        twin = TorchTwin(RayTwin(profile))
        # two neighbours on either side of the boundary between the zones q = 0 and q = 1
        line = np.stack([np.linspace(0.1e-3, 0.8e-3, 2000), np.zeros(2000)], axis=-1)
        cells = 2 * np.round(twin.trace(nominal(), line).positions[:, 0] / 2)
        edge = int(np.argmax(np.abs(np.diff(cells))))
        left, right = line[edge : edge + 1], line[edge + 1 : edge + 2]
        direct = BRANCHES.index("direct")
        own = twin.trace(nominal(), right).phases[direct, 0]
        of_left = twin.trace(nominal(), right, left).phases[direct, 0]
        at_left = twin.trace(nominal(), left).phases[direct, 0]
        assert abs(own - at_left) > 100
        assert abs(of_left - at_left) < 10

    def test_no_parameter_is_dead_but_those_that_leave_the_mean_of_both_cameras_alone(self) -> None:
        profile = small_profile().model_copy(update={"lens_path": THICK})
        twin, points = TorchTwin(RayTwin(profile)), page_points(profile, 50)
        base = some_device(5)
        before, pixels_before = twin.trace(base, points), twin.pixels(base, points)
        for index, name in enumerate(NAMES):
            moved = base.copy()
            moved[index] += PRIORS[index]
            after, pixels = twin.trace(moved, points), twin.pixels(moved, points)
            changed_px = np.abs(pixels - pixels_before).max()
            turned = np.abs(np.angle(np.exp(1j * (after.phases - before.phases)))).max()
            assert (max(changed_px, turned) > 0.05) == (not name.startswith("cameras_apart")), name

    def test_camera_parameters_leave_the_other_camera_alone(self) -> None:
        profile = small_profile()
        twin, points = TorchTwin(RayTwin(profile)), page_points(profile, 20)
        base = twin.pixels(nominal(), points)
        for camera, other in ((0, 1), (1, 0)):
            shift = {f"{('in_phase', 'quadrature')[camera]}_shift_x_px": 3.0}
            moved = twin.pixels(only(**shift), points)
            np.testing.assert_allclose(moved[camera] - base[camera], np.tile([3.0, 0.0], (20, 1)), atol=1e-9)
            np.testing.assert_allclose(moved[other], base[other])

    def test_a_relay_that_magnifies_as_pixels_grow_changes_none(self) -> None:
        plain = small_profile()
        camera = plain.camera.model_copy(update={"pitch_m": 2 * plain.camera.pitch_m})
        larger = plain.model_copy(update={"camera": camera, "relay": Relay(magnification=2)})
        parameters, places = (torch.tensor(each) for each in (some_device(2), page_points(plain, 3)))
        seen = [RayTwin(profile).pixels(parameters, places) for profile in (plain, larger)]
        assert torch.equal(*seen)

    def test_phases_over_page_and_camera_are_what_their_names_say(self) -> None:
        profile = small_profile()
        twin = TorchTwin(RayTwin(profile))
        half = np.array([profile.page_width_m, profile.page_height_m]) / 2
        points = np.array([half, [half[0], 0], [0, half[1]], -half])
        base = twin.trace(nominal(), points)
        direct = BRANCHES.index("direct")
        place = base.places[direct] / half
        corner = half / np.hypot(*half)
        for name, expected in {
            "launch_defocus_rad": [1, corner[0] ** 2, corner[1] ** 2, 1],
            "launch_coma_y_rad": [corner[1], 0, corner[1] ** 3, -corner[1]],
            "launch_astigmatism_45_rad": [2 * corner[0] * corner[1], 0, 0, 2 * corner[0] * corner[1]],
            "camera_tilt_y_rad": place[:, 1],
            "camera_curvature_rad": ((place * corner) ** 2).sum(-1),
        }.items():
            phases = twin.trace(only(**{name: 1.0}), points).phases
            np.testing.assert_allclose((phases - base.phases)[direct], expected, atol=1e-9, err_msg=name)


class TestDerivatives:
    def test_gradients_equal_finite_differences(self) -> None:
        profile = small_profile()
        twin = RayTwin(profile)
        points = torch.tensor(page_points(profile, 2), dtype=torch.float64)
        units = torch.tensor(PRIORS)
        extent = profile.page_width_m

        def answers(scaled: torch.Tensor, at: torch.Tensor) -> tuple[torch.Tensor, ...]:
            places, phases, positions, pixels = twin(scaled * units, at * extent, points, at * extent)
            return places / extent, phases / 100, positions, pixels / 100

        start = torch.tensor(some_device(6) / PRIORS, dtype=torch.float64, requires_grad=True)
        at = (points / extent).clone().requires_grad_(True)
        assert torch.autograd.gradcheck(answers, (start, at), eps=1e-6, atol=1e-5, rtol=1e-5)
