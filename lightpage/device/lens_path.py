"""Optical path of a real Fourier lens beyond the ideal one's, to third order.

A lens in a 2f arrangement turns point (x, y) of its outer plane into a plane wave at its other focal plane, the pipe's
facet: exp(-i k/f (x X + y Y)). A real one adds the phase W(x, y, X, Y), a quartic polynomial by symmetry: Seidel's five
terms, with (x, y) as the field and (X, Y) as the aperture, and one that depends on the field alone.

Written with arithmetic alone, so that numpy and torch share it.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class SeidelTerms(NamedTuple):
    """Factors of the terms of W, rad/m^4 unless said otherwise; numbers or tensors."""

    piston: Any = 0.0
    """Of r^4, with r^2 = x^2 + y^2."""
    distortion: Any = 0.0
    """Of r^2 (x X + y Y)."""
    astigmatism: Any = 0.0
    """Of (x X + y Y)^2."""
    field_curvature: Any = 0.0
    """Of r^2 R^2, with R^2 = X^2 + Y^2."""
    coma: Any = 0.0
    """Of R^2 (x X + y Y)."""
    spherical: Any = 0.0
    """Of R^4."""
    defocus: Any = 0.0
    """Of R^2, rad/m^2: the outer plane does not stand in the focal plane, see `defocus`."""
    tilt_x: Any = 0.0
    """Of x R^2, rad/m^3: the outer plane is tilted, so that its defocus grows with the place."""
    tilt_y: Any = 0.0
    """Of y R^2."""

    def mirrored(self) -> SeidelTerms:
        """Return the path of the same lens met from the facet: a lens from camera plane to facet whose adjoint is used.

        The second lens is the first one's mirror image, so light takes the same path the other way. Camera coordinates
        are turned by half a turn, which changes the sign of the odd terms; the adjoint's conjugate changes all.
        """
        return self._replace(
            piston=-self.piston,
            astigmatism=-self.astigmatism,
            field_curvature=-self.field_curvature,
            spherical=-self.spherical,
            defocus=-self.defocus,
        )

    @property
    def couples(self) -> bool:
        """Return whether any term depends on the field; defocus does not."""
        return not all(isinstance(term, float) and term == 0.0 for term in self._replace(defocus=0.0))

    def defocus_at(self, x: Any, y: Any) -> Any:
        """The factor of R^2 that a plane's axial place and tilt make at a field point, rad/m^2."""
        return self.defocus + self.tilt_x * x + self.tilt_y * y

    def of_field(self, x: Any, y: Any) -> Any:
        """The part of W that depends on the field alone, radians."""
        r2 = x * x + y * y
        return self.piston * r2 * r2

    def of_both(self, x: Any, y: Any, across: Any, up: Any) -> Any:
        """The rest of W at field points (x, y) and aperture points (across, up), metres; arrays that broadcast."""
        r2, aperture2, product = x * x + y * y, across * across + up * up, x * across + y * up
        odd = self.distortion * r2 + self.coma * aperture2
        even = self.astigmatism * product * product + self.field_curvature * r2 * aperture2
        return odd * product + even + (self.spherical * aperture2 + self.defocus_at(x, y)) * aperture2

    def of_step(self, x: Any, y: Any, dx: Any, dy: Any, across: Any, up: Any) -> Any:
        """The change of `of_both` from the field point (x, y) to (x + dx, y + dy), without the rounding of either."""
        product, step = x * across + y * up, dx * across + dy * up
        r2, more = x * x + y * y, dx * (2 * x + dx) + dy * (2 * y + dy)
        aperture2 = across * across + up * up
        even = self.field_curvature * more + self.tilt_x * dx + self.tilt_y * dy + self.coma * step
        odd = self.distortion * (more * (product + step) + r2 * step)
        return odd + self.astigmatism * step * (2 * product + step) + aperture2 * even

    def slope(self, x: Any, y: Any, across: Any, up: Any) -> tuple[Any, Any]:
        """Derivatives of W by the aperture's two coordinates, rad/m."""
        r2, aperture2, product = x * x + y * y, across * across + up * up, x * across + y * up
        by_field = self.distortion * r2 + self.coma * aperture2 + 2 * self.astigmatism * product
        even = self.coma * product + self.field_curvature * r2 + self.defocus_at(x, y)
        by_aperture = 2 * even + 4 * self.spherical * aperture2
        return by_field * x + by_aperture * across, by_field * y + by_aperture * up

    def slope_on_field(self, x: Any, y: Any, across: Any, up: Any) -> tuple[Any, Any]:
        """Derivatives of W by the field's two coordinates, rad/m."""
        aperture2 = across * across + up * up
        swapped = SeidelTerms(
            piston=self.spherical,
            distortion=self.coma,
            astigmatism=self.astigmatism,
            field_curvature=self.field_curvature,
            coma=self.distortion,
            spherical=self.piston,
        )
        along_x, along_y = swapped.slope(across, up, x, y)
        return along_x + self.tilt_x * aperture2, along_y + self.tilt_y * aperture2

    def bend(self, x: Any, y: Any, across: Any, up: Any) -> tuple[Any, Any]:
        """Second derivatives of W by either of the aperture's coordinates, rad/m^2."""
        r2, aperture2, product = x * x + y * y, across * across + up * up, x * across + y * up
        even = self.coma * product + self.field_curvature * r2 + self.defocus_at(x, y)
        alike = 2 * even + 4 * self.spherical * aperture2

        def along(field: Any, aperture: Any) -> Any:
            by_field = 2 * self.astigmatism * field + 4 * self.coma * aperture
            return alike + by_field * field + 8 * self.spherical * aperture * aperture

        return along(x, across), along(y, up)


IDEAL = SeidelTerms()
"""No path beyond the ideal one."""
