"""Hard and soft iron of a three-axis magnetometer that is tumbled in a uniform field.

The readings y lie on an ellipsoid; B = C (y - o) maps them to a sphere. A rotation of B does not
change its magnitude, so C is chosen symmetric: the orientation of the axes is not observable.
"""

from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.calibration import ellipsoid, reading_faults

MIN_READINGS, MIN_DIRECTIONS = 50, 18
"""Minimum number of readings, and of cells with readings: two for each of the nine parameters."""
MIN_COVERAGE, GOOD_COVERAGE = 0.01, 0.1
"""Coverage at which errors of adjacent directions are amplified ten times (rejected), and three
times (warning)."""
MIN_THICKNESS = 0.05
"""Minimum ratio of smallest to largest spread of the readings; one axis of rotation has less."""
MAX_AXIS_RATIO = 5.0
"""Maximum ratio of longest to shortest axis; soft iron on a sensor's board causes about two."""
MAX_SCATTER = 0.1
"""Maximum scatter about the ellipsoid relative to its radius, without outliers: 0.01 to 0.03 is
typical, the noise of a sensor at rest 0.3 to 0.4."""
MAX_OFFSET_STD = 0.1
"""Maximum standard deviation of the offset relative to the radius, in the worst direction."""
GOOD_RESIDUAL = 0.05
"""Coefficient of variation (std/mean) of corrected magnitudes above which a warning is issued."""
GOOD_OUTLIER_FRACTION, MAX_OUTLIER_FRACTION = 0.01, 0.2
"""Fraction of outliers above which a warning is issued, or the scatter is not meaningful."""
MIN_GLITCH_DISTANCE, MAX_GLITCH_FRACTION = 5.0, 0.02
"""Minimum distance of glitches (data transfer errors) from the median, in median distances, and
their maximum fraction; more are due to a sensor that was mostly at rest."""


@dataclass(frozen=True)
class EllipsoidFit:
    """Calibration B = correction (y - offset), its accuracy and warnings; NaN if not computed."""

    offset: FloatArray
    """(3,), unit of the readings, sensor frame: hard iron and bias."""
    correction: FloatArray
    """(3, 3) symmetric positive definite, field unit per reading unit: soft iron, scale factors and
    non-orthogonality, up to a rotation."""
    field_magnitude: float
    """Magnitude of B: as given, or the mean radius for det(correction) = 1, in reading units."""
    residual: float
    """Coefficient of variation (std/mean) of ‖B‖ over all readings, including excluded ones."""
    residual_before: float
    """Coefficient of variation (std/mean) of ‖y‖, the magnitudes before correction."""
    offset_std: FloatArray
    """(3,), unit of the readings: standard deviation of `offset`."""
    correction_std: FloatArray
    """(3, 3) Standard deviation of each entry of `correction`."""
    field_magnitude_std: float
    """Standard deviation of `field_magnitude`; zero if it was given."""
    coverage: float
    """0 to 1: smallest eigenvalue of the weighted mean of f fᵀ over the directions, with the nine
    spherical harmonics f to degree two, which are the effects of the nine parameters on ‖B‖. One
    for even coverage, 0.008 for a hemisphere, zero for a ring. Errors shared by adjacent directions
    are amplified by up to 1/sqrt(coverage)."""
    n_readings: int
    """Number of readings used by the fit."""
    n_missing: int
    """Number of readings excluded because of a NaN."""
    n_saturated: int
    """Number of readings excluded because of saturation."""
    n_outliers: int
    """Number of excluded glitches, plus that of readings beyond OUTLIER_STDS from the ellipsoid."""
    reason: str
    """Reason for the rejection of the fit; empty if the fit is accepted."""
    warnings: tuple[str, ...]
    """Warnings about readings and accuracy."""

    @property
    def converged(self) -> bool:
        """Whether the calibration is valid."""
        return not self.reason

    def correct(self, readings: FloatArray) -> FloatArray:
        """Field (n, 3), in the unit of `field_magnitude`, of readings in the unit of `offset`."""
        return (np.asarray(readings, dtype=float) - self.offset) @ self.correction


def fit_ellipsoid(readings: FloatArray, field_magnitude: float | None = None) -> EllipsoidFit:
    """Fit the offset and the symmetric correction that map all readings to the same magnitude.

    `readings` (n, 3) are chronological, in any unit, from a sensor rotated in a uniform field.
    `field_magnitude` is in the unit requested for the corrected field. Raises ValueError for a
    wrong shape, an infinite reading, or a magnitude that is not positive and finite.

    A quadric initialises a robust geometric fit, with smaller weights for crowded directions. Noise
    of relative std s increases the radius by s², which is not corrected. [Renaudin10]_ and
    [KokSchon16]_ section V.A convert the quadric into offset and correction; the measure of
    coverage and the rejection criteria are additions of this package.
    """
    readings = _validated(readings, field_magnitude)
    marks = reading_faults.missing_marks(readings)
    readings = np.where(reading_faults.are_marked(readings, marks), np.nan, readings)
    present: BoolArray = ~np.any(np.isnan(readings), axis=1)
    is_saturated = reading_faults.saturated_readings(readings)
    is_saturated = reading_faults.with_margin(is_saturated) & present[:, None]
    valid = readings[present & ~is_saturated.any(axis=1)]
    glitches = _glitches(valid)
    valid = valid[~glitches]
    nan = float('nan')
    fit = EllipsoidFit(
        offset=np.full(3, nan), correction=np.full((3, 3), nan), field_magnitude=nan, residual=nan,
        residual_before=_relative_spread(np.linalg.norm(readings[present], axis=1)),
        offset_std=np.full(3, nan), correction_std=np.full((3, 3), nan), field_magnitude_std=nan,
        coverage=nan, n_readings=len(valid), n_missing=int((~present).sum()),
        n_saturated=int(is_saturated.any(axis=1).sum()), n_outliers=int(glitches.sum()),
        reason=_insufficient_data(valid), warnings=_notes_on_input(present, is_saturated, marks))
    if fit.reason:
        return fit
    centre, scale = valid.mean(axis=0), float(np.sqrt(valid.var(axis=0).sum()))
    z = (valid - centre) / scale
    o, C, reason = ellipsoid.fit_quadric(z)
    if reason:
        return replace(fit, reason=reason)
    o, C, P, quality = ellipsoid.refine_ellipsoid(z, o, C)
    axes = np.linalg.eigvalsh(C)
    if not axes[0] * MAX_AXIS_RATIO >= axes[2]:
        return replace(fit, reason=f'the axes of the ellipsoid have a ratio of {axes[0]:.2g} to '
                       f'{axes[2]:.2g}, maximum 1 to {MAX_AXIS_RATIO:g}; '
                       + ellipsoid.POSSIBLE_CAUSES)
    fit = _in_units(fit, o, C, P, centre, scale, field_magnitude)
    residual = _relative_spread(np.linalg.norm(fit.correct(readings[present]), axis=1))
    n_outliers = fit.n_outliers + quality.n_outliers
    outlier_fraction = n_outliers / (len(valid) + glitches.sum())
    return replace(fit, residual=residual, n_outliers=n_outliers, coverage=quality.coverage,
                   reason=_rejection_reason(C, P, quality, outlier_fraction),
                   warnings=fit.warnings + _notes_on_fit(residual, quality, outlier_fraction))


def _validated(readings: FloatArray, field_magnitude: float | None) -> FloatArray:
    """Convert readings to an array (n, 3); raise ValueError for invalid arguments."""
    readings = np.asarray(readings, dtype=float)
    if readings.ndim != 2 or readings.shape[1] != 3:
        raise ValueError(f'readings must have the shape (n, 3), got {readings.shape}')
    is_infinite = np.isinf(readings).any(axis=1)
    if is_infinite.any():
        raise ValueError(f'reading {is_infinite.argmax()} is infinite: '
                         f'{readings[is_infinite.argmax()]}')
    if field_magnitude is not None and not 0.0 < field_magnitude < np.inf:
        raise ValueError(f'field_magnitude must be positive and finite, got {field_magnitude}')
    return readings


def _relative_spread(magnitudes: FloatArray) -> float:
    """Coefficient of variation of magnitudes; NaN if `magnitudes` is empty or all zero."""
    return float(magnitudes.std() / magnitudes.mean()) if magnitudes.any() else float('nan')


def _notes_on_input(present: BoolArray, is_saturated: BoolArray,
                    marks: FloatArray) -> tuple[str, ...]:
    """Warnings about missing and saturated readings."""
    notes: tuple[str, ...] = ()
    if not present.all():
        values = ', '.join(f'{v:.6g}' for v in np.unique(marks[~np.isnan(marks)]))
        notes += (f'readings excluded because of a missing axis: {np.count_nonzero(~present)}'
                  + (f' (marked by the value {values})' if values else ''),)
    if n_saturated := int(is_saturated.any(axis=1).sum()):
        axes = ', '.join(name for name, is_cut in zip('xyz', np.any(is_saturated, axis=0),
                                                      strict=True) if is_cut)
        notes += (f'readings excluded because of saturation of {axes}: {n_saturated}',)
    return notes


def _glitches(y: FloatArray) -> BoolArray:
    """Flags (n,) of readings far from the median, unless these are too many to be glitches."""
    if not len(y):
        return np.zeros(0, dtype=bool)
    distance = np.linalg.norm(y - np.median(y, axis=0), axis=1)
    is_far = distance > MIN_GLITCH_DISTANCE * np.median(distance)
    is_glitch: BoolArray = is_far & (is_far.sum() <= MAX_GLITCH_FRACTION * len(y))
    return is_glitch


def _insufficient_data(y: FloatArray) -> str:
    """Reason why no quadric can be fitted to the readings; empty if a fit is possible."""
    if len(y) < MIN_READINGS:
        return f'{len(y)} valid readings, minimum {MIN_READINGS}'
    largest = np.abs(y - y[0]).max()
    if not largest > 0.0:
        return f'all {len(y)} readings are equal: the sensor was not moved or is stuck'
    z = (y - y[0]) / largest
    spreads = np.linalg.svd(z - z.mean(axis=0), compute_uv=False)
    if not spreads[2] >= MIN_THICKNESS * spreads[0]:
        return (f'the readings lie in a plane: relative thickness {spreads[2] / spreads[0]:.2g}, '
                f'minimum {MIN_THICKNESS}; rotate the sensor about more than one axis')
    return ''


def _in_units(fit: EllipsoidFit, o: FloatArray, C: FloatArray, P: FloatArray, centre: FloatArray,
              scale: float, field_magnitude: float | None) -> EllipsoidFit:
    """Add normalised parameters with their covariance `P` to the result, in its units."""
    volume = np.linalg.det(C)**(-1.0 / 3.0)
    t = np.einsum('ij,kji->k', np.linalg.inv(C), ellipsoid.BASIS)
    if field_magnitude is None:
        k, magnitude = volume, scale * volume
        D = k * (ellipsoid.BASIS - C * t[:, None, None] / 3.0)
        magnitude_std = magnitude / 3.0 * np.sqrt(t @ P[3:, 3:] @ t)
    else:
        k, magnitude, magnitude_std = field_magnitude / scale, float(field_magnitude), 0.0
        D = k * ellipsoid.BASIS
    return replace(
        fit, offset=centre + scale * o, correction=k * C, field_magnitude=float(magnitude),
        offset_std=scale * np.sqrt(np.diagonal(P)[:3]),
        correction_std=np.sqrt(np.einsum('kij,kl,lij->ij', D, P[3:, 3:], D)),
        field_magnitude_std=float(magnitude_std))


def _rejection_reason(C: FloatArray, P: FloatArray, quality: ellipsoid.Quality,
                      outlier_fraction: float) -> str:
    """Reason for the rejection of a fit; empty if the fit is accepted."""
    if quality.scatter > MAX_SCATTER:
        return (f'the scatter about the ellipsoid is {quality.scatter:.2g} of the radius, '
                f'maximum {MAX_SCATTER}; {ellipsoid.POSSIBLE_CAUSES}')
    if outlier_fraction > MAX_OUTLIER_FRACTION:
        return (f'the fraction of outliers is {outlier_fraction:.2g}, maximum '
                f'{MAX_OUTLIER_FRACTION}')
    if quality.directions < MIN_DIRECTIONS:
        return f'readings in {quality.directions} directions, minimum {MIN_DIRECTIONS}'
    if quality.coverage < MIN_COVERAGE:
        return (f'the coverage is {quality.coverage:.2g}, minimum {MIN_COVERAGE}; octants with '
                f'few or no readings: {", ".join(quality.empty) or "none"}')
    offset_std = np.sqrt(np.linalg.eigvalsh(C @ P[:3, :3] @ C)[-1])
    if not offset_std <= MAX_OFFSET_STD:
        return (f'the standard deviation of the offset is {offset_std:.2g} of the radius, maximum '
                f'{MAX_OFFSET_STD}')
    return '' if quality.solved else 'least squares did not converge in 100 evaluations'


def _notes_on_fit(residual: float, quality: ellipsoid.Quality,
                  outlier_fraction: float) -> tuple[str, ...]:
    """Warnings about coverage, residual and outliers."""
    checks = {
        f'the coverage is {quality.coverage:.2g}, recommended at least {GOOD_COVERAGE}':
            quality.coverage < GOOD_COVERAGE,
        f'octants with few or no readings: {", ".join(quality.empty)}': quality.empty,
        f'the residual after correction is {residual:.2g}, recommended at most {GOOD_RESIDUAL}':
            residual > GOOD_RESIDUAL,
        f'the fraction of outliers is {outlier_fraction:.2g}':
            outlier_fraction > GOOD_OUTLIER_FRACTION}
    return tuple(note for note, holds in checks.items() if holds)
