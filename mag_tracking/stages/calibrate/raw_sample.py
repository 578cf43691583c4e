"""What a raw sample itself, and the calibration of its sensor, say of it."""

from math import inf, isnan

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.ordinary import without_iron
from mag_tracking.inference.axes import LEAST_PIVOT, smallest_pivots
from mag_tracking.records import MagSample


def fault_of(sample: MagSample, max_field: float) -> str | None:
    """Why a `MagSample` cannot be used, or None; `max_field` [T]."""
    # Of three numbers Python's own functions are several times as fast as NumPy's.
    x, y, z = sample.field.tolist()
    if not (abs(x) <= max_field and abs(y) <= max_field and abs(z) <= max_field):
        # Or an axis is missing.
        values = [abs(v) for v in (x, y, z) if not isnan(v)]
        if not values:
            return 'no axis reported (all NaN)'
        if max(values) == inf:
            return 'infinite value'
        if max(values) > max_field:
            return f'above {max_field:g} T (gauss or microtesla as tesla?)'
    if sample.covariance is None:
        return None
    if not (sample.covariance.shape == (3, 3)
            and _is_covariance(sample.field, sample.covariance)):
        return 'covariance is not positive definite'
    return None


def corrected(sample: MagSample, clock_ns: int, offset: FloatArray | None,
              C: FloatArray | None) -> MagSample:
    """The `MagSample` by the network's clock, without the sensor's own hard and soft iron.

    Parameters
    ----------
    sample : MagSample
    clock_ns : int
        What the sensor's clock is ahead of the network's.
    offset : (3,) [T] or None
    C : (3, 3) or None
        The correction of what is left; an axis that it would need and that is missing makes
        those missing that need it.
    """
    if offset is None and C is None and not clock_ns:
        return sample
    field, covariance, missing = np.empty(3), sample.covariance, np.isnan(sample.field)
    raw = np.array(np.where(missing, 0.0, sample.field), dtype=float)
    without_iron(raw, np.zeros(3) if offset is None else np.where(missing, 0.0, offset),
                 C is not None, np.eye(3) if C is None else np.array(C, dtype=float), field)
    if missing.any():
        field[missing if C is None else (C != 0.0) @ missing] = np.nan
    if C is not None and covariance is not None:
        covariance = C @ covariance @ C.T
    return MagSample(sample.stamp_ns - clock_ns, sample.sensor, field, covariance)


def _is_covariance(field: FloatArray, C: FloatArray) -> bool:
    """Whether C is finite, symmetric and positive definite, in the axes that `field` has."""
    there = ~np.isnan(field)
    of_present = C[np.ix_(there, there)]
    if not np.isfinite(of_present).all() \
            or np.abs(of_present - of_present.T).max() > 1e-6 * np.abs(of_present).max():
        return False
    return bool(smallest_pivots(field[None], C[None])[0] > LEAST_PIVOT)
