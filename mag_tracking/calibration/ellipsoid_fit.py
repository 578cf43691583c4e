"""Hard and soft iron of a three-axis magnetometer that can be tumbled, from field sizes alone.

In a uniform field the readings y of a turned sensor lie on an ellipsoid; B = C (y - o) puts them on
a sphere. A rotation of B changes no size, so C is taken symmetric: which way the sensor's axes
point cannot be told from sizes, and B keeps an unknown fixed rotation against the case.

Source: the change of the quadric into offset and matrix as in Renaudin, Afzal and Lachapelle,
Complete triaxis magnetometer calibration in the magnetic domain (2010), and Kok and Schön,
Magnetometer calibration using inertial sensors (2016), section V.A. The measure of coverage and the
refusals are this package's own.
"""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.calibration.ellipsoid_refinement import BASIS, Quality, refine_ellipsoid
from mag_tracking.calibration.quadric import DOUBT, fit_quadric
from mag_tracking.calibration.saturation import cut_off

MIN_READINGS = 50
"""Fewer readings than so many are refused ..."""

MIN_DIRECTIONS = 18
"""... and fewer cells with readings: two for each of the nine parameters."""

MIN_COVERAGE = 0.01
"""Refused below: what disturbs neighbouring directions alike enters ten times as large."""

GOOD_COVERAGE = 0.1
"""Warned of below: three times as large."""

MIN_THICKNESS = 0.05
"""Smallest over largest spread of readings about their mean; flatter is a rotation in a plane."""

MAX_ELONGATED = 5.0
"""Longest over shortest axis: soft iron on a sensor's board makes two, or little more."""

MAX_SCATTER = 0.1
"""Scatter about the ellipsoid, outliers apart, over its radius. A sensor that lies still gives a
ball of noise, which scatters 0.3 to 0.4 about any ellipsoid through it; usual is 0.01 to 0.03."""

MAX_UNCERTAIN = 0.1
"""Worst standard deviation of the offset, over the radius."""

GOOD_RESIDUAL = 0.05
"""A larger std/mean of the corrected sizes is warned of: the field was not uniform."""

MANY_OUTLIERS = 0.01
"""A larger share of outliers is warned of ..."""

MAX_OUTLIERS = 0.2
"""... and refused: the robust scatter has lost its meaning."""

GLITCH = 5.0
"""Readings further from the median reading than so many median distances are left out as glitches
of the transfer ..."""

FEW_GLITCHES = 0.02
"""... if their share is no larger: where the sensor lay still most of the time, all others are far
from the median."""


@dataclass(frozen=True)
class EllipsoidFit:
    """Calibration B = correction (y - offset), how well it is known, and what is wrong with it.

    What a refused fit could not compute is NaN.
    """

    offset: FloatArray
    """(3,), unit of the readings, sensor frame: hard iron and bias."""
    correction: FloatArray
    """(3, 3) symmetric positive definite, field unit per reading unit: soft iron, scale factors and
    skewness, up to a rotation."""
    field_size: float
    """What |B| is after correction, as given; or else the mean radius that comes with
    det(correction) = 1, in the unit of the readings."""
    residual: float
    """std/mean of |B| over all readings after correction, outliers and saturated ones included."""
    residual_before: float
    """std/mean of |y|."""
    offset_std: FloatArray
    """(3,), unit of the readings."""
    correction_std: FloatArray
    """(3, 3), of each entry of `correction`."""
    field_size_std: float
    """Zero where the field size was given."""
    coverage: float
    """0 to 1: smallest eigenvalue of the mean of f f^T over directions as the fit weighs them, f
    the nine spherical harmonics to degree two, which are what the nine parameters do to |B|. One
    for even coverage, 0.008 for half a sphere or a band of +-21 degrees, zero for a ring. Errors
    that neighbouring directions share enter up to 1/sqrt(coverage) times as large as with one."""
    empty_octants: tuple[str, ...]
    """Names such as '+x-y+z', of corrected directions, sensor frame."""
    n_readings: int
    """Readings that the fit was made from."""
    n_missing: int
    """Rows left out for a NaN."""
    n_saturated: int
    """Rows left out for standing at the end of the range."""
    n_outliers: int
    """Glitches, which are left out, and readings further than OUTLIER robust deviations from the
    ellipsoid, which the loss bounds."""
    converged: bool
    """Whether to use it."""
    reason: str
    """Why not; empty when converged."""
    warnings: tuple[str, ...]
    """What to know before using it."""

    def correct(self, readings: FloatArray) -> FloatArray:
        """(n, 3) corrected field of `readings` (n, 3)."""
        field: FloatArray = (np.asarray(readings, dtype=float) - self.offset) @ self.correction
        return field


class _Counts(TypedDict):
    """What is known of the readings alone; as in `EllipsoidFit`."""

    n_readings: int
    n_missing: int
    n_saturated: int
    n_outliers: int
    residual_before: float


class _Parameters(TypedDict):
    """Parameters and deviations in the readings' units; as in `EllipsoidFit`."""

    offset: FloatArray
    correction: FloatArray
    field_size: float
    offset_std: FloatArray
    correction_std: FloatArray
    field_size_std: float


def fit_ellipsoid(readings: FloatArray, field_size: float | None = None) -> EllipsoidFit:
    """Offset and symmetric correction that give all readings one size.

    A linear quadric fit starts a robust geometric least squares on |C (y - o)|. Readings count
    by direction: where they crowd, as while the sensor lay still, each weighs less.
    Noise of relative size s makes the radius s^2 too large, which is not corrected.

    Parameters
    ----------
    readings : (n, 3), any one unit, sensor frame
        In order of time, sensor turned in a uniform field; rows with a NaN are left out.
    field_size : float, optional
        Size of the true field, in the unit that the corrected field shall have.

    Returns
    -------
    EllipsoidFit
        Not converged, with a reason, where the readings do not tell the nine parameters. The
        standard deviations come from leaving stretches of time out in turn.

    Raises
    ------
    ValueError
        Readings that are not (n, 3), one that is infinite, a field size that is not positive.
    """
    readings = _checked(readings, field_size)
    present: BoolArray = ~np.any(np.isnan(readings), axis=1)
    cut = np.stack([cut_off(axis) for axis in readings.T], axis=1) & present[:, None]
    used = readings[present & ~cut.any(axis=1)]
    glitches = _glitches(used)
    used = used[~glitches]
    counts: _Counts = {
        'n_readings': len(used), 'n_missing': int((~present).sum()),
        'n_saturated': int(cut.any(axis=1).sum()), 'n_outliers': int(glitches.sum()),
        'residual_before': _spread(np.linalg.norm(readings[present], axis=1))}
    notes = _notes_on_input(counts, cut)
    reason = _too_little(used)
    if reason:
        return _refused(reason, counts, notes)
    centre, scale = used.mean(axis=0), float(np.sqrt(used.var(axis=0).sum()))
    z = (used - centre) / scale
    o, C, reason = fit_quadric(z)
    if reason:
        return _refused(reason, counts, notes)
    o, C, P, quality = refine_ellipsoid(z, o, C)
    axes = np.linalg.eigvalsh(C)
    if not axes[0] * MAX_ELONGATED >= axes[2]:
        return _refused(f'axes of the ellipsoid are as {axes[0]:.2g} to {axes[2]:.2g}, at most 1 '
                        f'to {MAX_ELONGATED:g} is plausible: {DOUBT}', counts, notes)
    counts['n_outliers'] += quality['n_outliers']
    out = _in_units(o, C, P, centre, scale, field_size)
    residual = _spread(np.linalg.norm((readings[present] - out['offset']) @ out['correction'],
                                      axis=1))
    share = counts['n_outliers'] / (len(used) + glitches.sum())
    reason = _why_refused(C, P, quality, share)
    return EllipsoidFit(**out, **counts, residual=residual, coverage=quality['coverage'],
                        empty_octants=quality['empty'], converged=not reason, reason=reason,
                        warnings=notes + _notes_on_fit(residual, quality, share))


def _checked(readings: FloatArray, field_size: float | None) -> FloatArray:
    """(n, 3) readings, or ValueError."""
    readings = np.asarray(readings, dtype=float)
    if readings.ndim != 2 or readings.shape[1] != 3:
        raise ValueError(f'expected readings (n, 3), got {readings.shape}')
    infinite = np.isinf(readings).any(axis=1)
    if infinite.any():
        raise ValueError(f'reading {infinite.argmax()} is infinite: {readings[infinite.argmax()]}')
    if field_size is not None and not 0.0 < field_size < np.inf:
        raise ValueError(f'field_size = {field_size}, must be positive and finite')
    return readings


def _spread(sizes: FloatArray) -> float:
    """std/mean; NaN without readings or with zeros only."""
    return float(sizes.std() / sizes.mean()) if sizes.any() else float('nan')


def _notes_on_input(counts: _Counts, cut: BoolArray) -> tuple[str, ...]:
    """Warnings about readings that are left out."""
    notes: tuple[str, ...] = ()
    if counts['n_missing']:
        notes += (f'{counts["n_missing"]} readings with a missing axis are left out',)
    if counts['n_saturated']:
        axes = ', '.join(name for name, is_cut in zip('xyz', np.any(cut, axis=0), strict=True)
                         if is_cut)
        notes += (f'{counts["n_saturated"]} readings at the end of the range of {axes} '
                  'are left out',)
    return notes


def _glitches(y: FloatArray) -> BoolArray:
    """(n,) bool, few readings far from all others."""
    distance = np.linalg.norm(y - np.median(y, axis=0), axis=1) if len(y) else np.zeros(0)
    far = distance > GLITCH * np.median(distance) if len(y) else np.zeros(0, dtype=bool)
    few: BoolArray = far & (far.sum() <= FEW_GLITCHES * len(y))
    return few


def _too_little(y: FloatArray) -> str:
    """Why no quadric can be fitted; empty where one can."""
    if len(y) < MIN_READINGS:
        return f'{len(y)} readings, needs {MIN_READINGS}'
    largest = np.abs(y - y[0]).max()
    if not largest > 0.0:
        return f'all {len(y)} readings are equal: the sensor lay still, or is stuck'
    z = (y - y[0]) / largest
    thick = np.linalg.svd(z - z.mean(axis=0), compute_uv=False)
    if not thick[2] >= MIN_THICKNESS * thick[0]:
        return (f'readings lie in a plane: thickness {thick[2] / thick[0]:.2g} of their extent, '
                f'needs {MIN_THICKNESS}; turn the sensor about more than one axis')
    return ''


def _in_units(o: FloatArray, C: FloatArray, P: FloatArray, centre: FloatArray, scale: float,
              field_size: float | None) -> _Parameters:
    """Parameters and deviations in the readings' units, by name."""
    volume = np.linalg.det(C)**(-1.0 / 3.0)
    t = np.einsum('ij,kji->k', np.linalg.inv(C), BASIS)
    if field_size is None:
        k, size = volume, scale * volume
        D = k * (BASIS - C * t[:, None, None] / 3.0)
        size_std = size / 3.0 * np.sqrt(t @ P[3:, 3:] @ t)
    else:
        k, size, size_std = field_size / scale, float(field_size), 0.0
        D = k * BASIS
    return {'offset': centre + scale * o, 'correction': k * C, 'field_size': float(size),
            'offset_std': scale * np.sqrt(np.diagonal(P)[:3]),
            'correction_std': np.sqrt(np.einsum('kij,kl,lij->ij', D, P[3:, 3:], D)),
            'field_size_std': float(size_std)}


def _why_refused(C: FloatArray, P: FloatArray, quality: Quality, outliers: float) -> str:
    """Why a fit is not to be used; empty where it is."""
    if quality['scatter'] > MAX_SCATTER:
        return (f'readings scatter {quality["scatter"]:.2g} of the radius about the ellipsoid, at '
                f'most {MAX_SCATTER}: {DOUBT}')
    if outliers > MAX_OUTLIERS:
        return f'a share of {outliers:.2g} of the readings are outliers, at most {MAX_OUTLIERS}'
    if quality['directions'] < MIN_DIRECTIONS:
        return f'{quality["directions"]} different directions, needs {MIN_DIRECTIONS}'
    if quality['coverage'] < MIN_COVERAGE:
        return (f'coverage {quality["coverage"]:.2g}, needs {MIN_COVERAGE}; octants without '
                f'readings: {", ".join(quality["empty"]) or "none"}')
    uncertain = np.sqrt(np.linalg.eigvalsh(C @ P[:3, :3] @ C)[-1])
    if not uncertain <= MAX_UNCERTAIN:
        return f'offset uncertain by {uncertain:.2g} of the radius, at most {MAX_UNCERTAIN}'
    return '' if quality['solved'] else 'least squares did not converge in 100 evaluations'


def _notes_on_fit(residual: float, quality: Quality, outliers: float) -> tuple[str, ...]:
    """Warnings about coverage, residual and outliers."""
    checks = {
        f'coverage {quality["coverage"]:.2g}, good is {GOOD_COVERAGE}':
            quality['coverage'] < GOOD_COVERAGE,
        f'few or no readings from {", ".join(quality["empty"])}': quality['empty'],
        f'residual {residual:.2g} after correction, good is {GOOD_RESIDUAL}':
            residual > GOOD_RESIDUAL,
        f'a share of {outliers:.2g} of the readings are outliers': outliers > MANY_OUTLIERS}
    return tuple(note for note, holds in checks.items() if holds)


def _refused(reason: str, counts: _Counts, notes: tuple[str, ...]) -> EllipsoidFit:
    """A fit of which nothing is known but why."""
    nan = float('nan')
    return EllipsoidFit(
        offset=np.full(3, nan), correction=np.full((3, 3), nan), field_size=nan, residual=nan,
        offset_std=np.full(3, nan), correction_std=np.full((3, 3), nan), field_size_std=nan,
        coverage=nan, empty_octants=(), converged=False, reason=reason,
        warnings=notes, **counts)
