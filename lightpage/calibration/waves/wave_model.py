"""The wave model of a calibrated device: the simulation's channel with the ray twin's fitted parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.parameters import NAMES, as_dict, indices
from lightpage.calibration.phases import camera_phase, launch_phase
from lightpage.device.lens_path import IDEAL, SeidelTerms
from lightpage.device.profile import Profile
from lightpage.waves.channel import WaveChannel
from lightpage.waves.geometry import WaveGeometry, cells_for
from lightpage.waves.grid import FieldGrid, field_grid, splitting_steps

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_ILLUMINATION = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Powers of (x, y) in an illumination."""
ILLUMINATIONS = len(_ILLUMINATION)
"""Number of its terms."""
_AT_CAMERA = frozenset(indices("camera_phase"))
"""Parameters whose change of the light needs no propagation."""
_BEHIND_PIPE = frozenset(
    index for index in indices("axial", "tilt", "tilt_apart") if not NAMES[index].startswith("modulator")
)
"""Parameters that change the light only behind the pipe."""


def fitted_geometry(profile: Profile, value: Mapping[str, Any]) -> WaveGeometry:
    """The geometry of fitted parameters by name, numbers or tensors; its cameras stand where they do on average."""
    width = profile.pipe.width_m * (1 + value["pipe_width_relative"])
    edges = profile.page_width_m / 2, profile.page_height_m / 2
    glass = IDEAL if profile.ideal_lenses else profile.seidel_terms(1 + value["lens_path_relative"])

    def placed(path: SeidelTerms, axial_rad: Any, plane: str, sign: int) -> SeidelTerms:
        tilts = (value[f"{plane}_axial_{axis}_rad"] for axis in "xy")
        tilt_x, tilt_y = (sign * defocus(tilt, width) / edge for tilt, edge in zip(tilts, edges, strict=True))
        return path._replace(defocus=sign * defocus(axial_rad, width), tilt_x=tilt_x, tilt_y=tilt_y)

    return WaveGeometry(
        wavelength_m=profile.light.wavelength_m,
        focal_length_m=profile.lens.focal_length_m * (1 + value["focal_length_relative"]),
        pipe_length_m=profile.pipe.length_m * (1 + value["pipe_length_relative"]),
        pipe_width_m=width,
        refractive_index=profile.pipe.refractive_index,
        pipe_angle=np.deg2rad(profile.pipe.angle_deg) + value["pipe_angle_rad"],
        pipe_roll=value["pipe_roll_rad"],
        lens_path=placed(glass, value["modulator_axial_rad"], "modulator", 1),
        # a lens from camera plane to facet, whose adjoint is used
        camera_path=placed(glass.mirrored(), axial_of_cameras(value)[0], "cameras", -1),
    )


def defocus(axial_rad: Any, width_m: Any) -> Any:
    """The factor of R^2 on a facet, rad/m^2, of a plane whose axial place is stated as a phase at the facet's wall."""
    return axial_rad * (2 / width_m) ** 2


def axial_place_m(axial_rad: float, profile: Profile) -> float:
    """Distance of a plane from the focal plane, metres, whose defocus is a phase at the facet's wall.

    The phase of a distance d at height R of the facet is pi d R^2 / (wavelength f^2).
    """
    factor = defocus(axial_rad, profile.pipe.width_m)
    return float(factor * profile.light.wavelength_m * profile.lens.focal_length_m**2 / np.pi)


def axial_of_cameras(value: Mapping[str, Any]) -> tuple[Any, Any]:
    """Axial place of both cameras on average, and half of what in-phase lies beyond quadrature; radians at the wall."""
    one, other = value["in_phase_axial_rad"], value["quadrature_axial_rad"]
    return (one + other) / 2, (one - other) / 2


def tilts_of_cameras_apart(value: Mapping[str, Any]) -> tuple[Any, Any]:
    """Half of how much more in-phase's axial place grows than quadrature's, to the right and lower edges; radians."""
    return value["cameras_apart_x_rad"], value["cameras_apart_y_rad"]


def modulator_axes(profile: Profile, samples: int) -> tuple[Real, Real]:
    """Places of so many samples per symbol and axis from the page's centre, [nx samples] and [ny samples], metres."""
    rows, columns = (count * samples for count in profile.page_shape)
    pitch = profile.symbol_pitch_m / samples
    x, y = ((np.arange(count) - (count - 1) / 2) * pitch for count in (columns, rows))
    return np.asarray(x), np.asarray(y)


def fitted_launch_phase(profile: Profile, value: Mapping[str, Any], geometry: WaveGeometry, x_m: Any, y_m: Any) -> Any:
    """Smooth phase at the launch side, radians, of places from the page's centre; numbers, arrays or tensors."""
    corner = profile.corner_m
    at = launch_phase(value, x_m / corner, y_m / corner)
    return at - _ramp(value, geometry, x_m, y_m)


def fitted_camera_phase(profile: Profile, value: Mapping[str, Any], geometry: WaveGeometry, x_m: Any, y_m: Any) -> Any:
    """Smooth phase against the reference at places of the camera plane, radians; numbers, arrays or tensors."""
    corner = profile.corner_m
    edges = profile.page_width_m / 2 / corner, profile.page_height_m / 2 / corner
    return camera_phase(value, x_m / corner, y_m / corner, *edges) + _ramp(value, geometry, x_m, y_m)


def _ramp(value: Mapping[str, Any], geometry: WaveGeometry, x_m: Any, y_m: Any) -> Any:
    """Return the phase over the page, radians, that an offset of the pipe from the lenses' axis causes."""
    per_metre = geometry.wave_number / geometry.focal_length_m
    return per_metre * (value["pipe_centre_x_m"] * x_m + value["pipe_centre_y_m"] * y_m)


class LaunchConditions(NamedTuple):
    """Conditions under which a page's light is launched, beside symbols, modulation and geometry.

    Attributes:
        illumination: coefficients [T] of `illumination_terms`.
        blur: as for `FittedWaves`.
    """

    illumination: Complex
    blur: float


class FittedWaves:
    """Modulator to common grid and back, with fitted geometry and smooth phases.

    Args:
        profile: the nominal device.
        parameters: [P] fitted (or, for an oracle, true) parameters of the ray twin.
        samples: samples per symbol and axis on the modulator's side.
        filled: whether each sample stands for a pixel of that size; else for a point.
        stride: samples of the common grid from one to the next that is computed.
        accuracy: share of the splitting steps that a simulation takes.
        grid: the common grid, where it is not the usual one.
        like: waves whose work is shared as far as geometry and sampling are the same.
        changed: fields of the geometry that are not as fitted, by name.
        blur: variance of the modulator's blur, over the square of its pixels' pitch.

    Attributes:
        samples: as given.
        x, y: places of the modulator's samples over the page's half width and half height, [nx samples], [ny samples].
        channel: lenses and pipe.
        launch: [ny samples, nx samples] phasor of the smooth phases at the launch side.
        against_reference: [Gy, Gx] phasor of the smooth phases at the camera, which multiplies all light there.
    """

    def __init__(
        self,
        profile: Profile,
        parameters: Real,
        samples: int,
        *,
        filled: bool = False,
        stride: int = 1,
        accuracy: float = 1.0,
        grid: FieldGrid | None = None,
        like: FittedWaves | None = None,
        changed: Mapping[str, Any] | None = None,
        blur: float = 0.0,
    ) -> None:
        self.samples = samples
        value = as_dict(parameters)
        geometry = replace(fitted_geometry(profile, value), **(changed or {}))
        grid = grid or field_grid(profile)
        grid_x, grid_y = grid.x_m[::stride], grid.y_m[::stride]
        x, y = modulator_axes(profile, samples)
        pitch = profile.symbol_pitch_m / samples
        self.x, self.y = x / (profile.page_width_m / 2), y / (profile.page_height_m / 2)
        page = x + value["page_centre_x_m"], y + value["page_centre_y_m"]
        self._sampling = (
            geometry,
            value["page_centre_x_m"],
            value["page_centre_y_m"],
            samples,
            filled,
            stride,
            accuracy,
            grid.shape,
            blur,
        )
        self.channel: WaveChannel
        shared = like if like is not None and like._sampling == self._sampling else None
        if shared is not None:
            self.channel = shared.channel
        else:
            own = WaveChannel(
                geometry,
                *page,
                grid_x,
                grid_y,
                cells=cells_for(geometry, *page, float(grid.x_m[-1]), float(grid.y_m[-1])),
                steps=splitting_steps(profile, accuracy),
                envelope_m=pitch if filled else 0.0,
                blur_m2=blur * profile.slm.pitch_m**2,
            )
            self.channel = own if like is None else own.sharing(like.channel)
        at_launch = fitted_launch_phase(profile, value, geometry, x[None, :], y[:, None])
        at_camera = fitted_camera_phase(profile, value, geometry, grid_x[None, :], grid_y[:, None])
        self.launch: Complex = np.exp(1j * at_launch)
        self.against_reference: Complex = np.exp(1j * at_camera)
        self._apart = defocus(axial_of_cameras(value)[1], geometry.pipe_width_m)
        self._tilts = tilts_of_cameras_apart(value)
        self._channels: tuple[WaveChannel, WaveChannel]
        if shared is not None and shared._tilts == self._tilts:
            self._channels = shared._channels
        else:
            self._channels = self._tilted(profile, 1), self._tilted(profile, -1)
            for mine, theirs in zip(self._channels, like._channels if like else (), strict=False):
                mine.sharing(theirs)
        self._camera = self.against_reference / stride  # samples that stand for more area are larger

    def to_exit(self, field: Complex, passed: NDArray[Any] | float = 1.0) -> Complex:
        """Field on the modulator to the exit facet's grid; `passed` as for `WaveChannel.exit_field`."""
        return self.channel.exit_field(field * self.launch, passed)

    def to_camera(self, field: Complex) -> Complex:
        """Field on the modulator [ny samples, nx samples] to the common grid [Gy, Gx], against the reference."""
        return np.asarray(self.channel.camera_field(self.to_exit(field)) * self._camera)

    def to_cameras(self, field: Complex) -> Complex:
        """Return the field as each camera sees it from where it stands, in-phase and quadrature, [2, Gy, Gx]."""
        return self.from_exit(self.to_exit(field))

    def from_exit(self, leaving: Complex) -> Complex:
        """Field on the exit facet's grid to the common grid as either camera sees it, [2, Gy, Gx]."""
        if not self._apart and not any(self._tilts):
            return np.stack([self.channel.camera_field(leaving) * self._camera] * 2)
        both = zip(self._channels, self._beyond, strict=True)
        return np.stack([channel.camera_field(leaving, beyond) * self._camera for channel, beyond in both])

    def moved(self, index: int, there: FittedWaves, page: Complex, leaving: Complex, seen: Complex) -> Complex:
        """Return the field that each camera sees once one parameter is another, with as little propagation as it takes.

        Args:
            index: number of the parameter, none of those that move a camera across.
            there: the waves with that parameter.
            page, leaving, seen: the field on the modulator, and as these waves have it at the exit facet and cameras.
        """
        if index in _AT_CAMERA:
            return seen * (there.against_reference / self.against_reference)
        return there.from_exit(leaving) if index in _BEHIND_PIPE else there.to_cameras(page)

    def back_to_exit(self, seen: Complex) -> Complex:
        """Fields that either camera sees, [2, Gy, Gx], back to the exit facet's grid, by the adjoint of `from_exit`."""
        cameras = zip(self._channels, seen, self._beyond, strict=True)
        one, other = (channel.to_exit(field * self._camera.conj(), beyond) for channel, field, beyond in cameras)
        return np.asarray(one + other)

    def back_to_page(self, leaving: Complex) -> Complex:
        """Field on the exit facet's grid back to the modulator, by the adjoint of `to_exit`."""
        return np.asarray(self.channel.to_page(leaving) * self.launch.conj())

    def to_page(self, field: Complex) -> Complex:
        """Field on the common grid [Gy, Gx] back to the modulator, by the adjoint."""
        return self.back_to_page(self.channel.to_exit(field * self._camera.conj()))

    @property
    def _beyond(self) -> tuple[float, float]:
        """Defocus of either camera beyond that of both on average, rad/m^2."""
        return self._apart, -self._apart

    def _tilted(self, profile: Profile, sign: int) -> WaveChannel:
        """The channel to the in-phase camera (sign 1) or to the quadrature camera (-1), tilted as it is."""
        if not any(self._tilts):
            return self.channel
        geometry, edges = self.channel.geometry, (profile.page_width_m / 2, profile.page_height_m / 2)
        x, y = (
            sign * defocus(tilt, geometry.pipe_width_m) / edge for tilt, edge in zip(self._tilts, edges, strict=True)
        )
        path = geometry.camera_path  # of a lens whose adjoint is used
        path = path._replace(tilt_x=path.tilt_x - x, tilt_y=path.tilt_y - y)
        return replace(self.channel, geometry=replace(geometry, camera_path=path))


def on_modulator(page: NDArray[Any], samples: int) -> NDArray[Any]:
    """A page of light, [ny, nx], on the modulator, [ny samples, nx samples]."""
    return np.kron(page, np.ones((samples, samples)))


def illumination_terms(x: Any, y: Any) -> list[Any]:
    """Terms of an illumination that is a quadratic in the page's coordinates, over the modulator.

    Args:
        x, y: places over the page's half width and half height, arrays or tensors [nx] and [ny].

    Returns:
        Six of [ny, nx], the even one first.
    """
    return [x[None, :] ** i * y[:, None] ** j for i, j in _ILLUMINATION]
