"""Covariances of sensor axes, any of which may be missing, of mixtures and of two estimates."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference import core
from mag_tracking.records import plain

MIN_PIVOT = 1e-12
"""Pivot (see `smallest_pivots`) below which a covariance is singular up to rounding."""


def whitened_energy(y: FloatArray, C: FloatArray) -> tuple[FloatArray, IntArray]:
    """Whitened energy y' C^-1 y (n,) over the measured axes, and their number (n,), T10 eq. (5.16).

    NaN in `y` (n, 3) marks a missing axis, whose entries in `C` (n, 3, 3) are not read. Raises
    LinAlgError if a covariance is not positive definite.
    """
    energy, axes = np.empty(len(y)), np.empty(len(y), dtype=np.int64)
    if not core.energies(plain(y), plain(C), energy, axes):
        raise np.linalg.LinAlgError('a covariance is not positive definite')
    return energy, axes


def smallest_pivots(y: FloatArray, C: FloatArray) -> FloatArray:
    """Smallest pivot (n,) of each correlation matrix of `C` (n, 3, 3), over the measured axes.

    A pivot is the fraction of an axis's variance that the preceding axes do not explain; NaN or at
    most 0 if the covariance is not positive definite.
    """
    out = np.empty(len(y))
    core.smallest_pivots(plain(y), plain(C), out)
    return out


def are_valid_covariances(y: FloatArray, C: FloatArray) -> BoolArray:
    """Whether covariances `C` (n, 3, 3) are finite, symmetric and positive definite over the axes
    measured in `y` (n, 3)."""
    is_measured = ~np.isnan(y)
    finite = np.isfinite(C)
    is_used = is_measured[:, :, None] & is_measured[:, None, :]
    used_C = np.where(is_used & finite, C, 0.0)
    largest = np.abs(used_C).max(axis=(1, 2), initial=0.0)
    asymmetry = np.abs(used_C - np.swapaxes(used_C, 1, 2)).max(axis=(1, 2), initial=0.0)
    valid: BoolArray = (finite | ~is_used).all(axis=(1, 2)) & (asymmetry <= 1e-6 * largest) \
        & (smallest_pivots(y, C) > MIN_PIVOT)
    return valid


def second_moment(weights: FloatArray, differences: FloatArray,
                  covariances: FloatArray) -> FloatArray:
    """Second moment (d, d) of a Gaussian mixture about an estimate ([BarShalom01]_ section 1.4.16),
    from the `differences` (n, d) of the component means."""
    w = weights / weights.sum()
    moment: FloatArray = (np.einsum('n,nij->ij', w, covariances)
                          + np.einsum('n,ni,nj->ij', w, differences, differences))
    return moment


def inflated_to_cover(P: FloatArray, difference: FloatArray) -> FloatArray:
    """Inflate `P`, whose state begins with x and y, to cover another estimate ([Uhlmann03]_).

    `difference` is the other estimate minus this one, for the first components. The std along its
    horizontal part becomes at least the length of that part; the other components are inflated in
    proportion to their differences, fully correlated.
    """
    d = difference[:2]
    square, variance = float(d @ d), float(d @ P[:2, :2] @ d)
    if not square > 0.0 or square**2 <= variance:
        return P
    padded_difference = np.zeros(len(P))
    padded_difference[:len(difference)] = difference
    return P + (1.0 - variance / square**2) * np.outer(padded_difference, padded_difference)
