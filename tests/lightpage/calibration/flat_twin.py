"""A device too simple to be wrong: the page is imaged onto itself, each branch with a known shift and phase ramp."""

import numpy as np
from scipy import ndimage

from lightpage.calibration.interfaces import BRANCHES, Rays
from lightpage.device.profile import Profile


class FlatTwin:
    """Places are the points themselves, phases a ramp (rad/m), pixels the places over the camera's pitch.

    The quadrature camera may be turned by 180 degrees.
    """

    def __init__(self, profile: Profile, ramp: tuple[float, float] = (0.0, 0.0), turned: bool = False) -> None:
        self._pitch = profile.camera.pitch_m
        self._centre = np.array([profile.camera.columns_px - 1, profile.camera.rows_px - 1]) / 2
        self._ramp, self._turned, self.known = np.array(ramp), turned, 0

    def trace(self, parameters: np.ndarray, points: np.ndarray, anchors: np.ndarray | None = None) -> Rays:
        """See `lightpage.calibration.interfaces.Twin`."""
        branches = len(BRANCHES)
        places = np.broadcast_to(points, (branches, *points.shape)).copy()
        return Rays(places, np.tile(points @ self._ramp, (branches, 1)), np.zeros_like(points))

    def pixels(self, parameters: np.ndarray, places: np.ndarray) -> np.ndarray:
        """See `lightpage.calibration.interfaces.Twin`."""
        sides = (1, -1 if self._turned else 1)
        return np.stack([side * places / self._pitch + self._centre for side in sides])


class Picture:
    """A page's phasors [ny, nx] as light on the camera plane: soft squares, shifted, with a phase ramp (rad/m)."""

    _FINE = 8

    def __init__(
        self,
        profile: Profile,
        symbols: np.ndarray,
        shift_m: tuple[float, float] = (0.0, 0.0),
        ramp: tuple[float, float] = (0.0, 0.0),
        piston: float = 0.0,
    ) -> None:
        fine = np.kron(symbols, np.ones((self._FINE, self._FINE)))
        self._parts = [ndimage.gaussian_filter(p, self._FINE / 4) for p in (fine.real, fine.imag)]
        self._pitch = profile.symbol_pitch_m / self._FINE
        self._centre = (np.array(fine.shape[::-1]) - 1) / 2
        self._shift, self._ramp, self._piston = np.array(shift_m), np.array(ramp), piston

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """Light at camera-plane points [..., 2]."""
        on_page = places - self._shift
        column, row = np.moveaxis(on_page / self._pitch + self._centre, -1, 0)
        real, imaginary = (ndimage.map_coordinates(p, [row, column], order=1) for p in self._parts)
        return np.asarray((real + 1j * imaginary) * np.exp(1j * (on_page @ self._ramp + self._piston)))
