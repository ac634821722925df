"""Finds a device that was never calibrated by pages of user data: from nominal geometry, by their pilots alone.

A page's few pilots tell a place by chance, those of several pages together do not: they are the same on all, and only
the phase of each page is free. So the direct image is looked for on either camera over shifts and slopes of the phase,
which are the same on both; then the parameters are fitted that make the pilots' light most coherent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import NAMES, PARAMETERS, PRIORS, indices, nominal
from lightpage.calibration.patches import search_window
from lightpage.calibration.unknown_pages.pilot_light import PilotLight, nats, told_nats, told_slope
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError
from lightpage.page.pilots import Pilots
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_REACH_PX, _STEP_PX = 36.0, 3.0
"""How far the image is looked for, and by which steps: the light's correlation falls to half within 3."""
_LARGEST_SLOPE_RAD, _SLOPE_STEP_RAD = 50.0, 1.5
"""Slopes of the phase that are tried, from the page's middle to its edge: the page's centre and the reference's tilt
anywhere in the capture range."""
_ANGLES: Real = np.deg2rad(np.arange(-1.5, 1.51, 0.1))
"""Pipe angles that are tried."""
_PRIOR_SHARE = 0.5
"""Of the deviations of `PARAMETERS`: about how devices of one make differ."""
_TURN_RAD = 0.06
"""Standard deviation of the angle between the arms about a right one."""
_WORTH = 0.33
"""Of a nat that the light seems to tell: what rays leave out of a pilot's light is the same on all pages."""
_ONE_CAMERA = 0.6
"""Of that, where cameras are looked at by themselves: both show the same light of other symbols."""
_CAMERA_GROUPS = ("in_phase", "quadrature", "centre", "camera_phase")
_SHAPE_GROUPS = (*_CAMERA_GROUPS, "lengths", "distortion", "launch", "roll")
_LEAST_NATS = 170.0
"""That pages together must tell of what was found. Eight of a bench device tell 300 or more; seven tell 80 of the best
that a search finds with pilots that are not theirs. Every 4 beyond that are e times less likely by chance: pages are
not quite unrelated, or it would be every one."""
_DIFFERENCE = 2e-3
"""Finite difference of the derivatives, in standard deviations of the priors."""
_CONVERGED = 1e-5
"""Relative gain below which another step does not pay."""
_BRANCHES = ("direct", "x", "y")
_CENTRE = [NAMES.index(f"page_centre_{axis}_m") for axis in "xy"]
_SHIFTS = [[NAMES.index(f"{camera}_shift_{axis}_px") for axis in "xy"] for camera in ("in_phase", "quadrature")]
_ANGLE = NAMES.index("pipe_angle_rad")


class FoundDevice(NamedTuple):
    """A geometry that pilots have shown.

    Attributes:
        parameters: [P].
        turn_rad: angle between the homodyne arms.
    """

    parameters: Real
    turn_rad: float


def find_device(
    twin: Twin,
    profile: Profile,
    pairs: Sequence[FramePair],
    references: FramePair,
    pilots: Pilots,
    progress: Progress = lambda what, share: None,
) -> FoundDevice:
    """Find a device from nominal geometry.

    Args:
        twin: ray tracer of the nominal device.
        profile: the nominal device.
        pairs: frames of one page each; eight tell enough.
        references: reference-only frames taken with them.
        pilots: nominal phases of the pilots that all of them carry.
        progress: told of every step. It may raise to stop the work.

    Raises:
        CalibrationError: the pilots tell of none.
    """
    work = _Search(twin, profile, PilotLight(twin, profile, pairs, references, pilots), progress)
    start = work.direct()
    cameras = work.fitted("fit the direct image", start, _CAMERA_GROUPS, _BRANCHES[:1], steps=10)
    shape = work.fitted("fit two branches", cameras, _SHAPE_GROUPS, _BRANCHES[:2], steps=15)
    together = work.fitted("fit the field", work.with_turn(shape), _SHAPE_GROUPS, _BRANCHES[:2], steps=15)
    groups = tuple(dict.fromkeys(parameter.group for parameter in PARAMETERS[: twin.known]))
    found = work.fitted("fit all branches", work.with_angle(together), groups, _BRANCHES, steps=25)
    told = work.told(found)
    if not told >= _LEAST_NATS:
        raise CalibrationError(
            "pilots",
            f"{told:.0f} nats that {len(pairs)} pages tell of a device",
            f"at least {_LEAST_NATS:.0f}: different pages of one device of the bundle's profile, with its pilots",
        )
    return FoundDevice(found.parameters, found.turn_rad)


class _Geometry(NamedTuple):
    """Parameters [P], on which side the quadrature arm is (0 where unknown), and its error, radians."""

    parameters: Real
    side: float = 0.0
    error_rad: float = 0.0

    @property
    def turn_rad(self) -> float:
        """Angle between the arms."""
        return self.side * np.pi / 2 + self.error_rad


class _Search:
    """The steps of a search.

    Args:
        twin, profile, progress: as for `find_device`.
        light: of the pilots.
    """

    def __init__(self, twin: Twin, profile: Profile, light: PilotLight, progress: Progress) -> None:
        self._twin, self._profile, self._light, self._progress = twin, profile, light, progress
        self._half = np.array([profile.page_width_m, profile.page_height_m]) / 2
        self._done = 0

    def _begin(self, what: str) -> Callable[[float], None]:
        """Tell of the next of six steps, and give what tells of a share of it."""
        number = self._done
        self._done += 1

        def tell(share: float) -> None:
            self._progress(what, (number + share) / 6)

        tell(0.0)
        return tell

    def direct(self) -> _Geometry:
        """Find the place of the direct image on either camera, and the slope of its phase."""
        tell = self._begin("find the direct image")
        axis = np.arange(-_LARGEST_SLOPE_RAD, _LARGEST_SLOPE_RAD + _SLOPE_STEP_RAD, _SLOPE_STEP_RAD)
        slopes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        shares = self._light.shares(nominal(), _BRANCHES[:1])[0]
        sloping = shares[:, None] * np.exp(-1j * (self._light.centres / self._half) @ slopes.T)
        sloping = (sloping / np.linalg.norm(shares)).astype(np.complex64)
        pixel = self._profile.image_pixel_m
        window = search_window(_REACH_PX * pixel, _STEP_PX * pixel)
        told = []
        for number, shift in enumerate(window):
            tell(number / len(window))
            light = self._light.seen(nominal(), _BRANCHES[:1], tuple(shift))[:, :, 0]
            light /= np.maximum(np.linalg.norm(light, axis=-1, keepdims=True), 1e-30)
            told.append(nats(np.abs(light.astype(np.complex64) @ sloping) ** 2, len(shares)).sum(axis=1))
        by_shift = np.stack(told)  # [shifts, cameras, slopes]
        best = int(np.argmax(by_shift.max(axis=0).sum(axis=0)))
        return _Geometry(self._placed(slopes[best], window[by_shift[..., best].argmax(axis=0)]))

    def _placed(self, slope_rad: Real, shifts_m: Real) -> Real:
        """The parameters whose direct image has such a slope, and lies so on either camera, [2, 2]."""
        across = np.vstack([np.diag(self._half), -np.diag(self._half), np.zeros((1, 2))]) / 10

        def look(parameters: Real) -> tuple[Real, Real]:
            rays = self._twin.trace(parameters, across)
            return 5 * (rays.phases[0][:2] - rays.phases[0][2:4]), rays.places[0][4:]

        found, (level, middle) = nominal(), look(nominal())
        sloping = []
        for index in _CENTRE:
            there = nominal()
            there[index] = step = _DIFFERENCE * PRIORS[index]
            sloping.append((look(there)[0] - level) / step)
        found[_CENTRE] = np.linalg.solve(np.transpose(sloping), slope_rad)
        here = self._twin.pixels(found, look(found)[1])[:, 0]
        for camera, shift in enumerate(shifts_m):
            found[_SHIFTS[camera]] = self._twin.pixels(nominal(), middle + shift)[camera, 0] - here[camera]
        return found

    def with_turn(self, geometry: _Geometry) -> _Geometry:
        """Find the side of the quadrature arm, by the cameras' phases of the same light."""
        light = self._light.seen(geometry.parameters, _BRANCHES[:2])
        pages = np.sum(light * self._light.shares(geometry.parameters, _BRANCHES[:2]), axis=(-2, -1))
        return geometry._replace(side=float(np.sign(np.sum(pages[0] * pages[1].conj()).imag)))

    def with_angle(self, geometry: _Geometry) -> _Geometry:
        """The pipe's angle that makes most of all branches."""
        tell = self._begin("find the pipe's angle")
        tried = []
        for number, angle in enumerate(_ANGLES):
            tell(number / len(_ANGLES))
            there = geometry.parameters.copy()
            there[_ANGLE] = angle
            tried.append(geometry._replace(parameters=there))
        return max(tried, key=self._worth)

    def fitted(
        self, what: str, start: _Geometry, groups: tuple[str, ...], branches: tuple[str, ...], steps: int
    ) -> _Geometry:
        """The geometry of the parameters of `groups` that makes most of some branches, under the priors."""
        tell, free = self._begin(what), indices(*groups)
        scale, done = _PRIOR_SHARE * PRIORS[free], 0

        def moved(vector: Real) -> _Geometry:
            parameters = start.parameters.copy()
            parameters[free] = vector[:-1] * scale
            return start._replace(parameters=parameters, error_rad=float(vector[-1]) * _TURN_RAD)

        def told(intermediate_result: object) -> None:
            nonlocal done
            done += 1
            tell(min(done / steps, 1.0))

        def lost(vector: Real) -> tuple[float, Real]:
            geometry = moved(vector)
            light, slopes = self._light.slopes(geometry.parameters, branches, free, _DIFFERENCE * scale)
            expected = self._light.shares(geometry.parameters, branches)
            gain, slope = _worth_of(light, expected, geometry)
            by_free = np.real(np.sum(slopes * slope, axis=(1, 2, 3, 4))) * scale
            turning = 1j * np.exp(1j * geometry.turn_rad)
            by_turn = np.real(np.sum(slope[0] * turning * light[1])) * _TURN_RAD if geometry.side else 0.0
            return float(np.sum(vector**2) / 2 - gain), vector - np.append(by_free, by_turn)

        found = scipy.optimize.minimize(
            lost,
            np.append(start.parameters[free] / scale, start.error_rad / _TURN_RAD),
            jac=True,
            method="L-BFGS-B",
            callback=told,
            options={"maxiter": steps, "ftol": _CONVERGED},
        )
        return moved(found.x)

    def _worth(self, geometry: _Geometry) -> float:
        """Logarithm of how likely a geometry is by all branches, up to a constant."""
        light, expected = self._seen(geometry)
        angle = geometry.parameters[_ANGLE] / (_PRIOR_SHARE * PRIORS[_ANGLE])
        return float(_worth_of(light, expected, geometry)[0] - angle**2 / 2)

    def _seen(self, geometry: _Geometry) -> tuple[Complex, Real]:
        """The pilots' light along all branches, and what is expected of it."""
        return self._light.seen(geometry.parameters, _BRANCHES), self._light.shares(geometry.parameters, _BRANCHES)

    def told(self, geometry: _Geometry) -> float:
        """Return the evidence of all pages together for a geometry, nats."""
        light, expected = self._seen(geometry)
        return float(told_nats(light[0] + np.exp(1j * geometry.turn_rad) * light[1], expected).sum())


def _worth_of(light: Complex, expected: Real, geometry: _Geometry) -> tuple[float, Complex]:
    """Return the worth of light [cameras, pages, B, N], and its slope by a change of it, the same shape."""
    if not geometry.side:
        worth = _WORTH * _ONE_CAMERA
        return worth * float(told_nats(light, expected).sum()), worth * told_slope(light, expected)
    arms = np.exp(1j * np.array([0.0, geometry.turn_rad]))[:, None, None, None]
    together = np.sum(arms * light, axis=0)
    return _WORTH * float(told_nats(together, expected).sum()), _WORTH * arms * told_slope(together, expected)
