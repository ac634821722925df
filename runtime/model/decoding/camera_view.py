"""Takes back what a decoder claims of symbols that a camera does not show, where the image lies partly off it."""

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import monomial_powers
from lightpage.device.profile import Profile
from lightpage.runtime.model.decoding.page import Inference
from lightpage.waves.grid import field_grid

Real = NDArray[np.float64]


class CameraView:
    """The frames of both cameras, and where the symbols' own images lie on them.

    A symbol counts as shown where the middle of its image lies on both frames. Networks are trained on whole images:
    they claim a symbol of which half is missing as if it were there, and are wrong in one of ten. An estimator knows
    how much of each symbol's light the cameras measure where the calibration saw the image. There, all symbols count
    as shown, and elsewhere those too that the calibration saw beside a camera.

    Args:
        profile: the nominal device.
        registration: registration of the model, [2, 2, 10]; None where it is unknown, and all symbols count as shown.
        places: along every branch, the direct one first, grid samples (column, row) [B, 2, ny, nx]; None as above.
        measured: whether concentrations follow from the light that the cameras measure of each symbol.
    """

    def __init__(
        self,
        profile: Profile,
        registration: NDArray[np.float32] | None,
        places: NDArray[np.float32] | None,
        *,
        measured: bool = False,
    ) -> None:
        self._profile, self._registration, self._measured = profile, registration, measured
        self._places = None if places is None else places[0].astype(np.float64)

    def seen(self, inference: Inference, registration: NDArray[np.float32] | None = None) -> Inference:
        """The inference without a concentration where a camera does not show the symbol.

        Args:
            inference: inference of a page.
            registration: registration of the page, where its image has moved.
        """
        registration = self._registration if registration is None else registration
        if self._places is None or registration is None or self._shown(registration, self._rim).all():
            return inference
        whole = _terms(self._profile, self._places)
        shown = self._shown(registration, whole)
        if self._measured and self._registration is not None:
            shown = shown | ~self._shown(self._registration, whole)
        return replace(inference, concentration=inference.concentration * shown)

    @cached_property
    def _rim(self) -> Real:
        """Monomials of the symbols about the page's rim: where both cameras show these, they show all."""
        assert self._places is not None
        rows, columns = self._places[:, [0, -1]], self._places[:, :, [0, -1]]
        return _terms(self._profile, np.concatenate([rows.reshape(2, -1), columns.reshape(2, -1)], axis=1))

    def _shown(self, registration: NDArray[np.float32], terms: Real) -> NDArray[np.bool_]:
        """Return whether both frames show places whose terms are [10, ...], bool [...]."""
        pixels = np.moveaxis(np.tensordot(registration, terms, 1), 1, -1)
        end = np.array(self._profile.frame_shape[::-1]) - 0.5
        return np.asarray(np.all((pixels >= -0.5) & (pixels <= end), axis=(0, -1)))


def _terms(profile: Profile, places: Real) -> Real:
    """Return the monomials of places [2, ...] in grid samples, [10, ...], in the order of a registration."""
    grid = field_grid(profile)
    x, y = (axis[0] + place * grid.pitch_m for axis, place in zip((grid.x_m, grid.y_m), places, strict=True))
    return np.stack([(x / profile.corner_m) ** i * (y / profile.corner_m) ** j for i, j in monomial_powers()])
