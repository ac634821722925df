"""The published ray tracer: one ray for each point of the page, through both lenses and the pipe, differentiable.

The modulator lies in the front focal plane of the launch lens and sends every ray out parallel to the axis. The pipe's
entrance lies in the back focal plane. The de-launch lens is the launch lens reversed, with the pipe's exit in its front
focal plane and the cameras in its back one. A wall that is met too steeply to reflect totally loses the ray.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lightpage.device.lenses import LensPrescription, Surface
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError

_NEWTON_STEPS = 8
"""Each doubles the digits; a lens's surface takes four or five, more only close to a sphere's rim."""

_TOUCHED_M = 1e-12
"""A ray that is no further than this from a surface after the Newton steps has met it."""

_RIM = 1e-2
"""A surface ends where 1 - (1 + conic) c^2 r^2 has fallen to this: a sphere at 0.995 of its radius."""

_SMALLEST_SQUARE = 1e-12
"""Stands in for the squared cosine behind a surface that does not let a ray out, so that no derivative is infinite."""

_WIDEST_ANGLE = math.pi / 6
"""Radians. Up to here a corner of the cross-section reflects a ray three times at most."""


class Traced(NamedTuple):
    """Landing places of rays.

    Attributes:
        places: places on the camera plane, metres from the axis, the flip of the two lenses taken out, [N, 2] float64.
            That of a lost ray is finite and means nothing.
        valid: whether the ray gets there, [N] bool.
        reflections: how often it was reflected at the walls x = +-w/2 and at the walls y' = +-w/2, [N, 2] int64.
    """

    places: Tensor
    valid: Tensor
    reflections: Tensor


class _Rays(NamedTuple):
    """Positions [N, 3], metres, z from the modulator; unit directions [N, 3]; whether they are still there, [N]."""

    position: Tensor
    direction: Tensor
    valid: Tensor

    def kept(self, good: Tensor) -> _Rays:
        """Lose the rays that are not `good`: they go on along the axis, so that all that follows of them is finite."""
        axis = self.position.new_tensor([0.0, 0.0, 1.0])
        position = torch.where(good[:, None], self.position, self.position * axis)
        direction = torch.where(good[:, None], self.direction, axis)
        return _Rays(position, direction, self.valid & good)

    def along(self, distance: Tensor) -> Tensor:
        """Positions at `distance` [N], metres, [N, 3]."""
        return self.position + distance[:, None] * self.direction

    def until(self, z: Tensor) -> Tensor:
        """Distances to the planes z [N], metres, [N]."""
        return (z - self.position[:, 2]) / self.direction[:, 2]


class RayTracer(nn.Module):
    """Traces the rays of one nominal device. Its pipe is a prism over the parallelogram |x|, |y'| < w/2.

    Without a prescription the lenses are ideal: they obey the sine condition, as in the wave channel and the twin.
    A ray parallel to the axis at (x, y) comes to the centre of the entrance with the direction sines -(x, y)/f, and one
    that leaves the pipe with sines s lands at f s, wherever it left. With slopes in place of sines every ray would land
    at the same place, as walls keep the length of s, but the outer ones would meet walls sooner.

    Args:
        profile: the nominal device.
        lens: the launch lens; the focal length of the profile plays no part then.

    Raises:
        InvalidInputError: a lens with a focal plane inside or on the wrong side.
    """

    def __init__(self, profile: Profile, lens: LensPrescription | None = None) -> None:
        super().__init__()
        if lens is not None and min(lens.front_focal_m, lens.back_focal_m) <= 0:
            got = f"focal planes {lens.front_focal_m:g} m before and {lens.back_focal_m:g} m behind it"
            raise InvalidInputError(f"lens {lens.name}", got, "both outside of the glass")
        self.lens = lens
        self.focal_length = profile.lens.focal_length_m
        self.index = profile.pipe.refractive_index
        self.pipe_length = profile.pipe.length_m
        self.pipe_width = profile.pipe.width_m

    def forward(self, points: Tensor, angle: Tensor) -> Traced:
        """Trace one ray for each point. The places can be differentiated, once, by both arguments.

        Args:
            points: points on the page (x, y), metres from its centre, [N, 2] float64.
            angle: the pipe's angle in place of the profile's, radians, scalar float64.

        Raises:
            InvalidInputError: points or angle of the wrong shape or type, not finite, or an angle beyond 30 degrees.
        """
        stops, reflections = self._follow(points, angle)
        return Traced(-stops[-1].position[:, :2], stops[-1].valid, reflections)

    def path(self, points: Tensor, angle: Tensor) -> Tensor:
        """Return the path of each ray, for drawing: arguments and errors of `forward`.

        Returns:
            Positions (x, y, z), metres, z from the modulator, [K, N, 3]: modulator, each surface of the launch lens,
            entrance, every wall met, exit, each surface of the de-launch lens, camera. They are as they lie in space,
            flip included. A ray that meets fewer walls than another repeats its last position; one that is lost has NaN
            from there on. An ideal lens is a single surface, a sphere of radius f about the centre of the facet.
        """
        stops, _ = self._follow(points, angle)
        return torch.stack([torch.where(at.valid[:, None], at.position, torch.nan) for at in stops])

    def _follow(self, points: Tensor, angle: Tensor) -> tuple[list[_Rays], Tensor]:
        """The rays behind all that they meet, in order, and their reflections [N, 2]."""
        _check(points, angle)
        position = torch.cat([points, torch.zeros_like(points[:, :1])], dim=-1)
        axis = position.new_tensor([0.0, 0.0, 1.0]).expand_as(position)
        stops = [_Rays(position, axis, torch.ones_like(points[:, 0], dtype=torch.bool))]
        stops += self._launch(stops[-1])
        within, reflections = self._pipe(stops[-1], angle)
        stops += within
        return stops + self._delaunch(stops[-1]), reflections

    def _launch(self, rays: _Rays) -> list[_Rays]:
        """Trace from the modulator to the plane of the entrance, still in air."""
        if self.lens is not None:
            return _through(self.lens, rays)
        squared = (rays.position[:, :2] ** 2).sum(-1)
        rays = rays.kept(squared < self.focal_length**2)
        sines = -rays.position[:, :2] / self.focal_length
        cosine = torch.sqrt(1 - (sines**2).sum(-1, keepdim=True))
        bent = rays._replace(direction=torch.cat([sines, cosine], dim=-1))
        facet = torch.zeros_like(bent.position) + bent.position.new_tensor([0.0, 0.0, 2 * self.focal_length])
        return [bent._replace(position=facet - self.focal_length * bent.direction), bent._replace(position=facet)]

    def _delaunch(self, rays: _Rays) -> list[_Rays]:
        """Trace from the plane of the exit, in air, to the cameras."""
        if self.lens is not None:
            return _through(self.lens.reversed(), rays)
        at_lens = rays.position + self.focal_length * rays.direction
        place = self.focal_length * rays.direction[:, :2]
        camera = torch.cat([place, rays.position[:, 2:] + 2 * self.focal_length], dim=-1)
        return [rays._replace(position=at_lens), rays._replace(position=camera)]

    def _pipe(self, rays: _Rays, angle: Tensor) -> tuple[list[_Rays], Tensor]:
        """Trace from the plane of the entrance, in air, to that of the exit, in air, and count the reflections."""
        none, half = torch.zeros_like(angle), self.pipe_width / 2
        normals = torch.stack(
            [torch.stack([none + 1, none, none]), torch.stack([torch.sin(angle), torch.cos(angle), none])]
        )
        rays = rays.kept(((rays.position @ normals.T).abs() <= half).all(dim=-1))
        end, flat = rays.position[:, 2] + self.pipe_length, rays.position.new_tensor([[0.0, 0.0, 1.0]])
        rays = _refracted(rays, flat, 1 / self.index)
        stops: list[_Rays] = []
        reflections = torch.zeros_like(rays.position[:, :2], dtype=torch.int64)
        for _ in range(self._walls_met(rays.direction.detach())):
            speeds = rays.direction @ normals.T
            level = speeds == 0
            to_wall = torch.sign(speeds) * half - rays.position @ normals.T
            distances = torch.where(level, torch.inf, to_wall / torch.where(level, 1.0, speeds))
            distance, wall = distances.min(dim=-1)
            hit = distance < rays.until(end)
            if not hit.any():
                break
            position = rays.along(torch.where(hit, distance, 0.0))
            speed = torch.where(hit, speeds.gather(-1, wall[:, None])[:, 0], 0.0)
            direction = rays.direction - 2 * speed[:, None] * normals[wall]
            total = (1 - speed**2) * self.index**2 >= 1
            rays = _Rays(position, direction, rays.valid).kept(total)
            reflections = reflections + nn.functional.one_hot(wall, 2) * (hit & total)[:, None]
            stops.append(rays)
        stops.append(_refracted(rays._replace(position=rays.along(rays.until(end))), flat, self.index))
        return stops, reflections

    def _walls_met(self, direction: Tensor) -> int:
        """The most walls that rays of these directions in the glass can meet, those of both axes together.

        Walls keep a ray's slope against the axis, and so the way that it goes across the pipe. Of four walls in a row
        two face each other, since a corner reflects three times at most: between them the ray crosses the width.
        """
        slope = direction[:, :2].norm(dim=-1) / direction[:, 2]
        steepest = float(slope.max()) if len(slope) else 0.0
        return 4 * math.floor(steepest * self.pipe_length / self.pipe_width) + 3


def _check(points: Tensor, angle: Tensor) -> None:
    for subject, value in (("points", points), ("pipe angle", angle)):
        if value.dtype != torch.float64:
            raise InvalidInputError(subject, value.dtype, "torch.float64")
    if points.ndim != 2 or points.shape[1] != 2:
        raise InvalidInputError("points", f"shape {tuple(points.shape)}", "shape (N, 2)")
    if angle.ndim != 0:
        raise InvalidInputError("pipe angle", f"shape {tuple(angle.shape)}", "a scalar")
    if not torch.isfinite(points).all():
        raise InvalidInputError("points", "NaN or infinity", "finite metres")
    radians = float(angle.detach())
    if not abs(radians) <= _WIDEST_ANGLE:
        raise InvalidInputError("pipe angle", f"{radians:g} rad", f"at most {_WIDEST_ANGLE:.4f} rad either way")


def launched_path(lens: LensPrescription, points: Tensor, sines: Tensor) -> tuple[Tensor, Tensor]:
    """Trace rays from a lens's front focal plane to its back focal plane.

    Args:
        lens: the lens.
        points: [N, 2] metres.
        sines: direction sines there, [N, 2].

    Returns:
        Places [N, 2] and optical path beyond that along the axis, [N], metres; not finite where a ray is lost.
    """
    along = torch.sqrt(1 - (sines**2).sum(-1, keepdim=True))
    start = torch.cat([points, torch.zeros_like(points[:, :1])], dim=-1)
    rays = _Rays(start, torch.cat([sines, along], dim=-1), torch.ones_like(points[:, 0], dtype=torch.bool))
    stops, indices = _through(lens, rays), [1.0, *(surface.index for surface in lens.surfaces)]
    path = torch.zeros_like(points[:, 0])
    for stop, index in zip(stops, indices, strict=True):
        path = path + index * (stop.position - rays.position).norm(dim=-1)
        rays = stop
    glass = sum(surface.index * surface.thickness_m for surface in lens.surfaces)
    beyond = path - (lens.front_focal_m + glass + lens.back_focal_m)
    return rays.position[:, :2], torch.where(rays.valid, beyond, torch.nan)


def _through(lens: LensPrescription, rays: _Rays) -> list[_Rays]:
    """Trace rays through a lens, from its front focal plane, where they are, to its back focal plane."""
    vertex, before, stops = rays.position[:, 2] + lens.front_focal_m, 1.0, []
    for surface in lens.surfaces:
        rays, normal = _met(rays, surface, vertex, lens.diameter_m)
        rays = _refracted(rays, normal, before / surface.index)
        stops.append(rays)
        vertex, before = vertex + surface.thickness_m, surface.index
    return [*stops, rays._replace(position=rays.along(rays.until(vertex + lens.back_focal_m)))]


def _met(rays: _Rays, surface: Surface, vertex: Tensor, diameter_m: float) -> tuple[_Rays, Tensor]:
    """The rays where they meet a surface with its vertex at z = `vertex` [N], and its unit normals there, [N, 3].

    Newton steps find the place without a gradient; the last step, from there, has it exactly.
    """
    with torch.no_grad():
        distance = rays.until(vertex)
        for _ in range(_NEWTON_STEPS):
            distance = _newton(rays, surface, vertex, distance)
        at = rays.along(distance)
        height, _ = _height(surface, at, vertex)
        met = (height.abs() < _TOUCHED_M) & (_under_root(surface, at) > _RIM)
        found = met & (at[:, :2].norm(dim=-1) <= diameter_m / 2)
        # a lost ray goes along the axis, where the vertex is
        distance = torch.where(found, distance, vertex - rays.position[:, 2])
    rays = rays.kept(found)
    at = rays.along(_newton(rays, surface, vertex, distance))
    _, slope = _height(surface, at, vertex)
    return rays._replace(position=at), slope / slope.norm(dim=-1, keepdim=True)


def _newton(rays: _Rays, surface: Surface, vertex: Tensor, distance: Tensor) -> Tensor:
    height, slope = _height(surface, rays.along(distance), vertex)
    return distance - height / (slope * rays.direction).sum(-1)


def _height(surface: Surface, at: Tensor, vertex: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance of points behind a surface along z, [N] metres, and its gradient, [N, 3].

    The surface is z = c r^2 / (1 + sqrt(1 - (1 + conic) c^2 r^2)), carried on beyond its rim with the root there.
    """
    c, squared = surface.curvature, (at[:, :2] ** 2).sum(-1)
    root = torch.sqrt(torch.clamp(_under_root(surface, at), min=_RIM))
    height = at[:, 2] - vertex - c * squared / (1 + root)
    return height, torch.cat([-c * at[:, :2] / root[:, None], torch.ones_like(at[:, 2:])], dim=-1)


def _under_root(surface: Surface, at: Tensor) -> Tensor:
    """1 - (1 + conic) c^2 r^2, [N]: falls to `_RIM` and below where the surface has ended."""
    return torch.as_tensor(1 - (1 + surface.conic) * surface.curvature**2 * (at[:, :2] ** 2).sum(-1))


def _refracted(rays: _Rays, normal: Tensor, ratio: float) -> _Rays:
    """Refract rays at a surface with unit normals [N, 3] along the light; `ratio` is index before over index after."""
    along = (rays.direction * normal).sum(-1)
    squared = 1 - ratio**2 * (1 - along**2)
    onward = torch.sqrt(torch.clamp(squared, min=_SMALLEST_SQUARE))
    direction = ratio * rays.direction + (onward - ratio * along)[:, None] * normal
    return rays._replace(direction=direction).kept(squared > 0)
