"""Maximum likelihood of a page's phases: a first estimate by the adjoint waves, and Gauss-Newton steps.

`docs/reference/physics.md` derives them. Every symbol's phase is unknown, and with it the nuisance parameters of the
page. A step predicts the counts of both cameras, weighs what differs by its variance, sends that back by the adjoint
waves, and divides by the Fisher information of each symbol.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lightpage.calibration.likelihood.table import FLAT_FIELD, PIXEL_GAINS
from lightpage.calibration.sampling_table import APART
from lightpage.calibration.waves.wave_model import illumination_terms
from lightpage.device.profile import Profile
from lightpage.train.models.apart import Cameras
from lightpage.train.models.field import FieldRecovery, Measured, relative_power
from lightpage.train.models.likelihood.counts import looked_up, score_of_counts
from lightpage.train.models.likelihood.local_hessian import LocalHessian
from lightpage.train.models.likelihood.modulator import amplitude_and_slope, summed, to_samples
from lightpage.train.models.likelihood.nuisances import PageNuisances
from lightpage.train.models.parts import Parts, multiply, multiply_conjugate, parts, phasor, scaled
from lightpage.train.models.prediction import expected_phasors
from lightpage.train.models.waves import THINNED, Fidelity, Real, WaveMatrices, Waves, thinned_plane
from lightpage.waves.grid import FieldGrid, symbol_samples

FORWARD = Fidelity(0.005, 0.007)
"""Fidelity of the predicted light."""
BACKWARD = Fidelity(0.06, 0.05)
"""Fidelity of the adjoint. An error of the adjoint moves the estimate only by the same share of the noise."""
OPERATOR_INPUTS = ("parameters", "blur", "illumination", FLAT_FIELD)
"""Tensors of a table that the wave operators follow from."""
_EVERY = 4
"""Distance, in grid samples, between the residuals that chi-square uses."""
LARGEST_STEP_RAD = 1.0
"""Largest change of a phase by one step: the model is linear over less than a radian."""


class Operators(NamedTuple):
    """Wave operators of a device.

    Attributes:
        forward, backward: matrices to the cameras, and back.
        illumination: light of the modulator's samples where a symbol shows phase zero and unit amplitude, [ny S, nx S].
    """

    forward: WaveMatrices
    backward: WaveMatrices
    illumination: Parts


class Page(NamedTuple):
    """Measurements of a page on the common grid.

    Attributes:
        counts: of both cameras, low-passed, [2, Gy, Gx].
        reference: counts of the references, [2, Gy, Gx].
        amplitude: reference amplitude over its mean, [Gy, Gx].
        lit: 1 where both cameras have a reference, else 0, [Gy, Gx].
    """

    counts: Tensor
    reference: Tensor
    amplitude: Tensor
    lit: Tensor

    @property
    def thinned(self) -> Page:
        """Measurements on the thinned grid."""
        return Page(*map(thinned_plane, self))


class Estimate(NamedTuple):
    """State of the estimation.

    Attributes:
        p: phase and concentration of each symbol as a vector, [2, ny, nx]; the page's piston is taken off.
        nuisance: see `lightpage.train.models.likelihood.nuisances`, [6].
        deviations: deviations of the samples' phases from those of their symbols, radians, [ny S, nx S].
    """

    p: Tensor
    nuisance: Tensor
    deviations: Tensor

    @property
    def direction(self) -> Parts:
        """Unit phasors of the symbols' phases, [ny, nx]."""
        length = torch.sqrt(self.p.square().sum(0) + 1e-20)
        return self.p[0] / length, self.p[1] / length


class Likelihood(NamedTuple):
    """The log-likelihood's derivatives at an estimate, and the counts that it expects.

    Attributes:
        by_phase: derivative by each symbol's phase, [ny, nx].
        by_nuisance: derivatives by the nuisance parameters, [6].
        expected: counts that the light would give perfect cameras, [2, Gy, Gx].
        by_sample: derivative by the phase of each of the modulator's samples, [ny S, nx S].
        by_amplitude: derivative by a relative change of each symbol's amplitude, [ny, nx].
    """

    by_phase: Tensor
    by_nuisance: Tensor
    expected: Tensor
    by_sample: Tensor
    by_amplitude: Tensor


class _Prediction(NamedTuple):
    """Predicted light of an estimate.

    Attributes:
        exit_factor: factor of gain and shift on the exit facet, [fy, fx].
        tilt: phasor of the tilt on the common grid, [Gy, Gx].
        leaving: light on the exit facet.
        field: light on the common grid.
    """

    exit_factor: Parts
    tilt: Parts
    leaving: Parts
    field: Parts


class PhaseEstimator(nn.Module):
    """Estimator of one device's pages.

    Args:
        profile: nominal device.
        parameters: [P] fitted; they say how finely waves are sampled.
        grid: common grid, where it is not the usual one.
        forward, backward: fidelity of the waves either way.

    Attributes:
        coarse_start: whether the first step predicts light coarsely. A fine one says more where noise is strong.
    """

    def __init__(
        self,
        profile: Profile,
        parameters: Real,
        grid: FieldGrid | None = None,
        forward: Fidelity = FORWARD,
        backward: Fidelity = BACKWARD,
    ) -> None:
        super().__init__()
        # the root nearest to the linear field is enough: the first step mends more than rounds of its own would
        self.recovery = FieldRecovery(profile, rounds=0, grid=grid, corrected=True)
        self.samples = symbol_samples(profile)
        self.coarse_start = True
        self.waves = Waves(profile, parameters, self.samples, forward, filled=True, grid=grid)
        self.back = Waves(profile, parameters, self.samples, backward, filled=True, grid=grid, thinned=True)
        self.nuisances = PageNuisances(profile, self.waves.geometry, self.waves.cells, self.recovery.grid)
        self._half_width, self._half_height = profile.page_width_m / 2, profile.page_height_m / 2

    def operators(self, table: Mapping[str, Tensor]) -> Operators:
        """Return the wave operators of the tensors `OPERATOR_INPUTS` in the table."""
        parameters, blur = table["parameters"], table["blur"]
        terms = torch.stack(illumination_terms(self.waves.x_m / self._half_width, self.waves.y_m / self._half_height))
        smooth = parts(torch.tensordot(table["illumination"], terms, 1))
        illumination = multiply(smooth, phasor(to_samples(table[FLAT_FIELD], self.samples)))
        forward, backward = self.waves.matrices(parameters, blur), self.back.matrices(parameters, blur)
        return Operators(forward, backward, illumination)

    def measured(self, table: Mapping[str, Tensor], *frames: Tensor) -> tuple[Page, Measured]:
        """Measure a frame pair on the common grid.

        Args:
            table: `reference_in_phase`, `reference_quadrature`, `registration`, `homodyne`, those of cameras that stand
                apart, see `FieldRecovery.measure`, and `pixel_gains` of cameras with blemishes.
            frames: in-phase and quadrature frame [H, W].
        """
        apart = [table[name] for name in APART if name in table]
        blocks = self.recovery.in_blocks(table["reference_in_phase"], table["reference_quadrature"])
        references = self.recovery.references(blocks, table["registration"])
        gains = table.get(PIXEL_GAINS)
        measured = self.recovery.measure_against(blocks, references, *frames, table["homodyne"], *apart, gains=gains)
        counts = references.reference * (1 + 2 * torch.stack([measured.a, measured.b]))
        return Page(counts, references.reference, references.amplitude, references.lit), measured

    def first(
        self, operators: Operators, table: Mapping[str, Tensor], noise: Tensor, *frames: Tensor
    ) -> tuple[Estimate, Page, Tensor]:
        """Estimate the phases by the adjoint waves of the recovered field.

        Returns:
            The estimate; the page's measurements; power that is left of the homodyne equations over the field's, [].
        """
        page, measured = self.measured(table, *frames)
        field, unexplained = self.recovery.solve_samples(measured)
        light = self.back.to_page(operators.backward, field * page.lit)
        real, imaginary = multiply_conjugate(parts(light), operators.illumination)
        symbols = summed(real, self.samples), summed(imaginary, self.samples)
        phasors = scaled(symbols, torch.rsqrt(symbols[0] * symbols[0] + symbols[1] * symbols[1] + 1e-20))
        concentration = _concentration(table["information"], noise)
        direction, piston = without_piston(phasors, concentration, table)
        nuisance = torch.cat([torch.stack(piston), table["information"].new_zeros(4)])
        estimate = Estimate(torch.stack(direction) * concentration, nuisance, torch.zeros_like(real))
        return estimate, page, relative_power(unexplained, field)

    def likelihood(
        self,
        operators: Operators,
        table: Mapping[str, Tensor],
        page: Page,
        estimate: Estimate,
        cameras: Cameras | None = None,
        *,
        coarse: bool = False,
    ) -> Likelihood:
        """Evaluate the derivatives of the log-likelihood at an estimate.

        Args:
            operators, page, estimate: see there.
            table: `homodyne`, `amplitude_series`, `count_scale`, `count_weights`.
            cameras: defocus of cameras that stand apart.
            coarse: whether light is predicted with the fidelity of the way back and, unless cameras stand apart, on the
                thinned grid.
        """
        direction, turned = estimate.direction, phasor(estimate.deviations)
        amplitude, slope = amplitude_and_slope(direction, table["amplitude_series"])
        thinned = coarse and cameras is None  # cameras in different planes need neighbouring samples
        page = page.thinned if thinned else page
        light = self._predicted(operators, amplitude, estimate, coarse=coarse, thinned=thinned)
        score, expected = _score(table, page, light.field, cameras)
        if thinned:
            score = scaled(score, score[0].new_tensor(THINNED**2))
        at_exit = self.back.back_to_exit(operators.backward, multiply_conjugate(score, light.tilt), thinned=thinned)
        back = self.back.exit_to_page(operators.backward, multiply_conjugate(at_exit, light.exit_factor))
        back = multiply_conjugate(back, operators.illumination)
        symbol = multiply(self._on_samples(scaled(direction, amplitude)), turned)
        by_log = symbol[0] * back[0] + symbol[1] * back[1]
        by_turn = symbol[0] * back[1] - symbol[1] * back[0]
        by_sample = by_turn + to_samples(slope, self.samples) * by_log
        by_nuisance = self.nuisances.gradient(light.leaving, at_exit, light.field, score, THINNED if thinned else 1)
        by_phase = summed(by_sample, self.samples)
        by_amplitude = summed(by_log, self.samples)
        return Likelihood(by_phase, by_nuisance, expected, by_sample, by_amplitude)

    def expected_counts(
        self,
        operators: Operators,
        table: Mapping[str, Tensor],
        page: Page,
        estimate: Estimate,
        cameras: Cameras | None = None,
    ) -> Tensor:
        """Predict the counts that the light of an estimate would give perfect cameras, [2, Gy, Gx].

        Args:
            operators, table, page, estimate, cameras: see `likelihood`.
        """
        amplitude, _ = amplitude_and_slope(estimate.direction, table["amplitude_series"])
        light = self._predicted(operators, amplitude, estimate, coarse=False, thinned=False)
        return _score(table, page, light.field, cameras)[1]

    def _predicted(
        self, operators: Operators, amplitude: Tensor, estimate: Estimate, *, coarse: bool, thinned: bool
    ) -> _Prediction:
        """Predict the light of an estimate.

        Args:
            operators, estimate: see there.
            amplitude: amplitudes of the symbols' light, [ny, nx].
            coarse: see `likelihood`.
            thinned: whether light is predicted on the thinned grid.
        """
        waves, forward = (self.back, operators.backward) if coarse else (self.waves, operators.forward)
        light = self._on_samples(scaled(parts(expected_phasors(estimate.p)), amplitude))
        launched = multiply(multiply(light, phasor(estimate.deviations)), operators.illumination)
        exit_factor = self.nuisances.at_exit(estimate.nuisance)
        tilt = self.nuisances.tilt(estimate.nuisance, THINNED if thinned else 1)
        leaving = multiply(waves.to_exit(forward, launched), exit_factor)
        field = multiply(waves.exit_to_camera(forward, leaving, thinned=thinned), tilt)
        return _Prediction(exit_factor, tilt, leaving, field)

    def advanced(
        self,
        table: Mapping[str, Tensor],
        page: Page,
        estimate: Estimate,
        likelihood: Likelihood,
        noise: Tensor,
        *,
        start: bool = False,
    ) -> tuple[Estimate, Tensor]:
        """Move an estimate by the Gauss-Newton step of all phases and nuisance parameters together.

        While the others are at their expected light, the likelihood of a symbol's phasor x is that of a complex normal
        density about a point z, and that of its phase a von Mises density of mean arg(z), whose concentration grows
        with |z|. So the derivatives by phase and amplitude both count.

        The Hessian of the phases is approximated as local (`LocalHessian`). Their coupling with the nuisance parameters
        is kept: `responses` are the changes of all phases that compensate a unit change of a nuisance parameter best.

        Args:
            table: `amplitude_series`, `slope_power`, `count_scale`, `count_weights`, `information`, `responses`,
                `nuisance_precision`, `nuisance_covariance`, `point_spread`, `deviation_precision`, `pilot_phasors`,
                `pilot_mask`.
            page, estimate: see there.
            likelihood: derivatives at the estimate, see `likelihood`.
            noise: see `_concentration`, [2].
            start: whether this is the first step: deviations would follow the errors of the phases, and stay.

        Returns:
            The next estimate, and the mean square of the counts' residuals over their variance, [].
        """
        gain2 = estimate.nuisance[0] ** 2 + estimate.nuisance[1] ** 2
        direction = estimate.direction
        amplitude, slope = amplitude_and_slope(direction, table["amplitude_series"])
        power = amplitude * amplitude * (1 + slope * slope) / table["slope_power"]
        information = gain2 * power * table["information"]
        responses = table["responses"]
        gradient = torch.cat([likelihood.by_nuisance[:1], likelihood.by_nuisance[2:]])
        prior = torch.cat([torch.zeros_like(gradient[:1]), table["nuisance_precision"] * estimate.nuisance[2:]])
        right_hand_side = gradient - prior - (responses * likelihood.by_phase).sum((1, 2))
        change = table["nuisance_covariance"] @ right_hand_side / gain2
        hessian = self._hessian(table, estimate, slope, information)
        step, deviations = hessian.solve(likelihood.by_sample, None if start else estimate.deviations)
        step = step - (responses * change[:, None, None]).sum(0)
        step = torch.clamp(step, -LARGEST_STEP_RAD, LARGEST_STEP_RAD)
        by_amplitude = likelihood.by_amplitude * (1 + slope * slope) / information
        along = (torch.sqrt(expected_phasors(estimate.p).square().sum(0)) + by_amplitude) / (1 + change[0])
        length = torch.sqrt(along * along + step * step + 1e-20)
        concentration = _concentration(length * information, noise)
        turned = multiply(direction, (along / length, step / length))
        direction, piston = without_piston(turned, concentration, table)
        gain = multiply(scaled(parts(estimate.nuisance[:2]), 1 + change[0]), piston)
        nuisance = torch.cat([torch.stack(gain), estimate.nuisance[2:] + change[1:]])
        advanced = Estimate(torch.stack(direction) * concentration, nuisance, deviations)
        thinned = likelihood.expected.shape != page.counts.shape
        if thinned:
            page = page.thinned
        every = _EVERY // THINNED if thinned else _EVERY
        return advanced, _chi_square(table, page, likelihood.expected, every)

    def _hessian(
        self, table: Mapping[str, Tensor], estimate: Estimate, slope: Tensor, information: Tensor
    ) -> LocalHessian:
        """Local Hessian at an estimate, of symbols with so much information, [ny, nx]."""
        length = torch.rsqrt(1 + slope * slope)
        along = multiply(scaled(estimate.direction, length), (slope, torch.ones_like(slope)))
        along = multiply(self._on_samples(along), phasor(estimate.deviations))
        return LocalHessian(along, information, table["point_spread"], table["deviation_precision"])

    def _on_samples(self, symbols: Parts) -> Parts:
        """Light of symbols [ny, nx] on the modulator's samples, [ny S, nx S]."""
        return to_samples(symbols[0], self.samples), to_samples(symbols[1], self.samples)


def without_piston(phasors: Parts, weights: Tensor, table: Mapping[str, Tensor]) -> tuple[Parts, Parts]:
    """Turn phasors [ny, nx] so that those of pilots agree with the known ones; return them, and the phasor taken off.

    Args:
        phasors: unit phasors of the symbols.
        weights: their concentrations.
        table: `pilot_phasors` and `pilot_mask`; a page without pilots is left as it is.
    """
    known, mask = table["pilot_phasors"], table["pilot_mask"]
    real, imaginary = multiply(phasors, (known[0], -known[1]))
    total = torch.stack([(real * weights * mask).sum() + 1e-20, (imaginary * weights * mask).sum()])
    total = total / torch.sqrt(total.square().sum())
    return multiply(phasors, (total[0], -total[1])), (total[0], total[1])


def _concentration(information: Tensor, noise: Tensor) -> Tensor:
    """Concentration of symbols [ny, nx] of so much Fisher information: 1 / (noise[0] / information + noise[1])."""
    return information / (noise[0] + noise[1] * information)


def _score(table: Mapping[str, Tensor], page: Page, field: Parts, cameras: Cameras | None) -> tuple[Parts, Tensor]:
    """Derivative of the log-likelihood by the field [Gy, Gx], and the expected counts, [2, Gy, Gx]."""
    inverse = 1 / page.amplitude
    together = torch.stack(field)
    seen = [together, together] if cameras is None else [*cameras.seen(together).reshape(2, 2, *together.shape[1:])]
    cosine, sine = table["homodyne"].unbind()
    arms = (torch.ones_like(cosine), torch.zeros_like(sine)), (cosine, sine)
    expected, directions = [], []
    for camera, (arm, light) in enumerate(zip(arms, seen, strict=True)):
        along = light[0] * inverse + arm[0], light[1] * inverse + arm[1]
        reference = page.reference[camera]
        counts = reference * (along[0] * along[0] + along[1] * along[1])
        score = score_of_counts(
            counts, page.counts[camera], table["count_scale"][camera], table["count_weights"][camera]
        )
        expected.append(counts)
        directions.append(scaled(along, 2 * reference * score * page.lit * inverse))
    if cameras is None:
        (real, imaginary), other = directions
        return (real + other[0], imaginary + other[1]), torch.stack(expected)
    gathered = cameras.gathered(torch.stack([*directions[0], *directions[1]]))
    return parts(gathered), torch.stack(expected)


def _chi_square(table: Mapping[str, Tensor], page: Page, expected: Tensor, step: int) -> Tensor:
    """Mean square of the counts' residuals over their variance, [], on every `step`-th sample of the page's grid."""
    every = (slice(None), slice(None, None, step), slice(None, None, step))
    lit, total = page.lit[every[1:]], torch.zeros_like(page.lit[0, 0])
    for camera, (light, counts) in enumerate(zip(expected[every], page.counts[every], strict=True)):
        scale, weights = table["count_scale"][camera], table["count_weights"][camera]
        score = score_of_counts(light, counts, scale, weights)
        total = total + (lit * score * score / looked_up(weights[3], scale * torch.sqrt(light))).sum()
    return total / (2 * lit.sum() + 1e-6)
