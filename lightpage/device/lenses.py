"""Prescriptions of thick lenses in air: their surfaces, in the order in which light meets them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError

Real = NDArray[np.floating]


@dataclass(frozen=True)
class Surface:
    """A surface of revolution about the optical axis.

    Attributes:
        radius_m: radius of curvature at the vertex, metres, positive with its centre behind the surface; inf is flat.
        thickness_m: distance from its vertex to that of the next surface, metres.
        index: refractive index behind it.
        conic: conic constant; 0 is a sphere.
    """

    radius_m: float
    thickness_m: float
    index: float
    conic: float = 0.0

    @property
    def curvature(self) -> float:
        """1 / radius, 1/m."""
        return 1 / self.radius_m


@dataclass(frozen=True)
class LensPrescription:
    """A lens in air. Its focal lengths are paraxial.

    Args:
        name: name of the lens.
        surfaces: surfaces in order; the last one has no thickness, and air behind it.
        diameter_m: clear diameter of every surface, metres.

    Raises:
        InvalidInputError: no surface, glass behind the last one, or surfaces that do not focus.
    """

    name: str
    surfaces: tuple[Surface, ...]
    diameter_m: float

    def __post_init__(self) -> None:
        expected = "a last surface of thickness 0 and index 1"
        if not self.surfaces:
            raise InvalidInputError(f"lens {self.name}", "no surface", expected)
        last = self.surfaces[-1]
        if (last.thickness_m, last.index) != (0, 1):
            raise InvalidInputError(f"lens {self.name}", f"{last.thickness_m:g} m of index {last.index:g}", expected)
        if self._matrix[1, 0] == 0:
            raise InvalidInputError(f"lens {self.name}", "surfaces that do not focus", "a focal length")

    @property
    def _matrix(self) -> Real:
        """Takes (height, slope) of a paraxial ray at the first vertex to those behind the last one, [2, 2]."""
        matrix, before = np.eye(2), 1.0
        for surface in self.surfaces:
            bend = (before - surface.index) * surface.curvature / surface.index
            matrix = np.array([[1.0, 0.0], [bend, before / surface.index]]) @ matrix
            matrix = np.array([[1.0, surface.thickness_m], [0.0, 1.0]]) @ matrix
            before = surface.index
        return matrix

    @property
    def effective_focal_m(self) -> float:
        """Focal length, metres."""
        return float(-1 / self._matrix[1, 0])

    @property
    def back_focal_m(self) -> float:
        """Distance from the last vertex to the focal plane behind the lens, metres."""
        return float(-self._matrix[0, 0] / self._matrix[1, 0])

    @property
    def front_focal_m(self) -> float:
        """Distance from the focal plane in front of the lens to the first vertex, metres."""
        return float(-self._matrix[1, 1] / self._matrix[1, 0])

    def reversed(self) -> LensPrescription:
        """The same lens, met from behind."""
        in_front = [(0.0, 1.0), *((surface.thickness_m, surface.index) for surface in self.surfaces[:-1])]
        turned = (
            replace(surface, radius_m=-surface.radius_m, thickness_m=thickness_m, index=index)
            for surface, (thickness_m, index) in zip(self.surfaces, in_front, strict=True)
        )
        return replace(self, surfaces=tuple(turned)[::-1])


LENSES = {
    lens.name: lens
    for lens in (
        LensPrescription(
            name="AC508-080-A",
            surfaces=(
                Surface(radius_m=54.9e-3, thickness_m=16.0e-3, index=1.674748),
                Surface(radius_m=-46.4e-3, thickness_m=2.0e-3, index=1.815674),
                Surface(radius_m=-247.2e-3, thickness_m=0.0, index=1.0),
            ),
            diameter_m=50.8e-3,
        ),
    )
}
"""By name. AC508-080-A: Thorlabs' cemented achromat of 80 mm, N-BAF10 and N-SF6HT, indices at 532 nm."""

_THICK_WITHIN = 0.05
"""A prescription stands for lenses whose focal length is that close to its own."""


def lens_of(profile: Profile) -> LensPrescription | None:
    """The prescription of a device's real lenses, if there is one; none where they are ideal."""
    return None if profile.ideal_lenses else lens_of_length(profile.lens.focal_length_m)


def lens_of_length(focal_length_m: float) -> LensPrescription | None:
    """The prescription that a focal length suggests, if there is one."""
    suited = [lens for lens in LENSES.values() if abs(lens.effective_focal_m / focal_length_m - 1) < _THICK_WITHIN]
    return suited[0] if suited else None
