"""Covariances of the three axes of a sensor, any of which may be missing."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference import core
from mag_tracking.records import plain

MIN_PIVOT = 1e-12
"""Pivot (see `smallest_pivots`) below which a covariance is singular up to rounding."""


def whitened_energy(y: FloatArray, C: FloatArray) -> tuple[FloatArray, IntArray]:
    """Whitened energy y' C^-1 y of each measurement, over the measured axes.

    Parameters
    ----------
    y : (n, 3) array
        Measurement of each sensor; NaN for a missing axis.
    C : (n, 3, 3) array
        Noise covariance, in the squared unit of `y`, symmetric. Entries of missing axes are not
        read.

    Returns
    -------
    energy : (n,) array
        Chi-square distributed for noise alone; 0 if no axis is measured.
    axes : (n,) int array
        Number of measured axes.

    Raises
    ------
    ValueError
        If the shapes do not match.
    numpy.linalg.LinAlgError
        If a covariance is not positive definite.

    References
    ----------
    [T10]_ eq. (5.16).
    """
    y, C = _contiguous(y, C)
    energy, axes = np.empty(len(y)), np.empty(len(y), dtype=np.int64)
    if not core.energies(y, C, energy, axes):
        raise np.linalg.LinAlgError('a covariance is not positive definite')
    return energy, axes


def smallest_pivots(y: FloatArray, C: FloatArray) -> FloatArray:
    """Distance of covariances from singularity, over the measured axes.

    Parameters
    ----------
    y : (n, 3) array
        Measurement of each sensor; NaN for a missing axis.
    C : (n, 3, 3) array
        Noise covariance, in the squared unit of `y`, symmetric.

    Returns
    -------
    (n,) array
        Smallest pivot of the correlation matrix: the smallest fraction of an axis's variance that
        the preceding axes do not explain. 1 for uncorrelated axes; NaN or at most 0 if the
        covariance is not positive definite.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """
    y, C = _contiguous(y, C)
    out = np.empty(len(y))
    core.smallest_pivots(y, C, out)
    return out


def are_valid_covariances(y: FloatArray, C: FloatArray) -> BoolArray:
    """Whether covariances are finite, symmetric and positive definite over the measured axes.

    Parameters
    ----------
    y : (n, 3) array
        Measurement of each sensor; NaN for a missing axis.
    C : (n, 3, 3) array
        Noise covariance, in the squared unit of `y`.

    Returns
    -------
    (n,) bool array

    Raises
    ------
    ValueError
        If the shapes do not match.
    """
    y, C = _contiguous(y, C)
    is_measured = ~np.isnan(y)
    finite = np.isfinite(C)
    is_used = is_measured[:, :, None] & is_measured[:, None, :]
    used_C = np.where(is_used & finite, C, 0.0)
    largest = np.abs(used_C).max(axis=(1, 2), initial=0.0)
    asymmetry = np.abs(used_C - np.swapaxes(used_C, 1, 2)).max(axis=(1, 2), initial=0.0)
    valid: BoolArray = (finite | ~is_used).all(axis=(1, 2)) & (asymmetry <= 1e-6 * largest) \
        & (smallest_pivots(y, C) > MIN_PIVOT)
    return valid


def _contiguous(y: FloatArray, C: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Convert `y` and `C` to contiguous arrays; raise ValueError if the shapes do not match."""
    if y.shape != (len(y), 3) or C.shape != (len(y), 3, 3):
        raise ValueError('expected measurements (n, 3) and covariances (n, 3, 3), got '
                         f'{y.shape} and {C.shape}')
    return plain(y), plain(C)
