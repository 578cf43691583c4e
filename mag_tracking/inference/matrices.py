"""Matrices that are checked, brought to unit diagonal, whitened, and inverted."""

from contextlib import AbstractContextManager
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference import core


def whitened(H: ArrayLike, C: ArrayLike | None) -> FloatArray:
    """Rows of H in units of their noise (..., n_y, n_x); missing rows are zero."""
    H = np.asarray(H, dtype=float)
    if H.ndim < 2:
        raise ValueError(f'H needs shape (..., n_y, n_x), got {H.shape}')
    missing = np.isnan(H).all(axis=-1)
    raise_for_invalid('row of H ', 'finite or wholly NaN', H,
                      ~np.isfinite(H).all(axis=-1) & ~missing)
    H = np.where(missing[..., None], 0.0, H)
    if C is None:
        return H
    n_y = H.shape[-2]
    C = leading_broadcast('C', C, H.shape[:-1] + (n_y,))
    C = np.where(missing[..., :, None] | missing[..., None, :], np.eye(n_y), C)
    scale, w, V = unit_diagonal('C', C)
    raise_for_invalid('C', 'positive definite', C, w[..., 0] <= n_y * np.finfo(float).eps)
    out: FloatArray = np.swapaxes(V, -1, -2) @ (H / scale[..., None]) / np.sqrt(w)[..., None]
    return out


def leading_broadcast(name: str, A: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """A as a float array of `shape`; only leading axes may be left out."""
    A = np.asarray(A, dtype=float)
    try:
        if A.shape[-2:] == shape[-2:]:
            return np.broadcast_to(A, shape)
    except ValueError:
        pass
    raise ValueError(f'{name} has shape {A.shape}, needed is {shape}')


def raise_for_invalid(name: str, fault: str, A: FloatArray, bad: BoolArray | np.bool_) -> None:
    """Raise ValueError for the first matrix of A (..., n, n) that is `bad` (...)."""
    for at in np.argwhere(bad).tolist():
        raise ValueError(f'{name}{at or ""} is not {fault}: {A[tuple(at)].tolist()}')


def unit_diagonal(name: str, A: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scale, eigenvalues and vectors of A / (scale scale'), once A is fit for it."""
    if A.ndim < 2 or A.shape[-1] != A.shape[-2]:
        raise ValueError(f'{name} has to be square, got {A.shape}')
    raise_for_invalid(name, 'finite', A, ~np.isfinite(A).all(axis=(-2, -1)))
    diagonal = np.einsum('...ii->...i', A)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    unit = A / (scale[..., :, None] * scale[..., None, :])
    skew = np.abs(unit - np.swapaxes(unit, -1, -2))
    raise_for_invalid(name, 'symmetric', A, (skew > 1e-9).any(axis=(-2, -1)))
    w, V = np.linalg.eigh(unit)
    raise_for_invalid(name, 'positive semidefinite', A,
                      (w < -1e-9).any(-1) | (diagonal < 0.0).any(-1))
    return scale, w, V


def triangular_factor(A: FloatArray) -> FloatArray:
    """R of A = Q R."""
    # The stub of numpy knows only of the pair.
    return cast(FloatArray, np.linalg.qr(A, mode='r'))


def ignoring_overflow() -> AbstractContextManager[None]:
    """Start of a block in which numbers may grow beyond all bounds: a search that does so costs
    infinity.
    """
    return np.errstate(over='ignore', invalid='ignore')


PSEUDO_INVERSE_TOLERANCE = 1e-15
"""Directions whose eigenvalue is below this share of the largest are those of rounding errors."""


def pseudo_inverse(A: FloatArray, rank: float = PSEUDO_INVERSE_TOLERANCE) -> FloatArray:
    """Pseudo-inverses (n, k, k), scaled to unit diagonal first: units differ by decades.

    Directions whose eigenvalue is then below the share `rank` of the largest are left out. A
    matrix that is not finite, of a search that ran away, has an inverse of NaN. Of full rank the
    lower triangles count.
    """
    A = np.ascontiguousarray(A, dtype=float)
    inverse: FloatArray = np.empty_like(A)
    # It takes a hundredth of the time of the eigenvalues.
    if core.inverses(A, MIN_PIVOT_ROOT, inverse):
        return inverse
    finite: BoolArray = np.all(np.isfinite(A), axis=(1, 2))
    if not finite.all():
        A = np.where(finite[:, None, None], A, np.eye(A.shape[1]))
    scale = np.sqrt(np.einsum('nii->ni', A))
    scale = np.where(scale > 0.0, scale, 1.0)
    w, V = np.linalg.eigh(A / (scale[:, :, None] * scale[:, None, :]))
    w = np.where(w > rank * w[:, -1:], w, np.inf)
    V = V / scale[:, :, None]
    with ignoring_overflow():
        inverse = (V / w[:, None, :]) @ np.swapaxes(V, 1, 2)
    inverse[~finite] = np.nan
    return inverse


MIN_PIVOT_ROOT = 1e-3
"""The least root of a pivot that is left to a matrix whose inverse needs no care."""
