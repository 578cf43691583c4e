"""Covariances of the three axes of a sensor, some of which may be missing."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference import core
from mag_tracking.records import plain

MIN_PIVOT = 1e-12
"""A covariance with a smaller one of `smallest_pivots` is singular, but for rounding."""


def whitened_energy(y: FloatArray, C: FloatArray) -> tuple[FloatArray, IntArray]:
    """Energy of a measurement in units of its noise: y' C^-1 y over the axes present.

    Parameters
    ----------
    y : (n, 3)
        Per sensor; NaN = missing axis.
    C : (n, 3, 3)
        Covariance, same unit squared, symmetric; not read where `y` is missing.

    Returns
    -------
    energy : (n,)
        0 where no axis is present.
    axes : (n,) int
        How many are.

    Raises numpy.linalg.LinAlgError where a covariance is not positive definite.
    Source: T10 eq. (5.16).
    """
    y, C = _checked(y, C)
    energy, axes = np.empty(len(y)), np.empty(len(y), dtype=np.int64)
    if not core.energies(y, C, energy, axes):
        raise np.linalg.LinAlgError('a covariance is not positive definite')
    return energy, axes


def smallest_pivots(y: FloatArray, C: FloatArray) -> FloatArray:
    """How far the covariance of each sensor is from singular, over the axes that are present.

    The arrays are as for `whitened_energy`. Returns (n,): of the covariance in units of its own
    variances, the least share of one axis that those before it do not tell. 1 = no axes go
    together; NaN or not positive: not positive definite.
    """
    y, C = _checked(y, C)
    out = np.empty(len(y))
    core.smallest_pivots(y, C, out)
    return out


def are_valid_covariances(y: FloatArray, C: FloatArray) -> BoolArray:
    """Whether covariances are finite, symmetric and positive definite, over the axes present.

    The arrays are as for `whitened_energy`. Returns (n,).
    """
    y, C = _checked(y, C)
    there = ~np.isnan(y)
    finite = np.isfinite(C)
    read = there[:, :, None] & there[:, None, :]
    known = np.where(read & finite, C, 0.0)
    largest = np.abs(known).max(axis=(1, 2), initial=0.0)
    asymmetry = np.abs(known - np.swapaxes(known, 1, 2)).max(axis=(1, 2), initial=0.0)
    valid: BoolArray = (finite | ~read).all(axis=(1, 2)) & (asymmetry <= 1e-6 * largest) \
        & (smallest_pivots(y, C) > MIN_PIVOT)
    return valid


def _checked(y: FloatArray, C: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both as compiled code takes them. Raises ValueError where the shapes do not fit."""
    if y.shape != (len(y), 3) or C.shape != (len(y), 3, 3):
        raise ValueError(f'covariances of shape {C.shape} for axes of shape {y.shape}')
    return plain(y), plain(C)
