"""Matrix validation, scaling to unit diagonal, whitening and pseudo-inverses."""

from contextlib import AbstractContextManager

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference import core


def whitened(H: ArrayLike, C: ArrayLike | None) -> FloatArray:
    """Whiten the rows of matrices `H` (..., n_y, n_x) to uncorrelated noise of variance 1.

    A row of NaN is not measured and becomes zero. `C` (..., n_y, n_y) broadcasts against `H`; None
    if `H` is whitened already.
    """
    H = np.asarray(H, dtype=float)
    if H.ndim < 2:
        raise ValueError(f'H must have shape (..., n_y, n_x), got {H.shape}')
    missing = np.isnan(H).all(axis=-1)
    raise_for_invalid('row of H ', 'finite or all NaN', H,
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
    """Broadcast `A` read-only over leading axes to `shape`."""
    A = np.asarray(A, dtype=float)
    try:
        if A.shape[-2:] == shape[-2:]:
            return np.broadcast_to(A, shape)
    except ValueError:
        pass
    raise ValueError(f'{name} has shape {A.shape}, expected {shape}')


def raise_for_invalid(name: str, requirement: str, value: ArrayLike,
                      is_invalid: BoolArray | np.bool_ | bool) -> None:
    """Raise ValueError for the first entry of `value` that is flagged in `is_invalid`, if any."""
    for index in np.argwhere(is_invalid).tolist():
        actual = np.asarray(value)[tuple(index)].tolist()
        raise ValueError(f'{name}{index or ""} must be {requirement}, got {actual}')


def unit_diagonal(name: str, A: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scale symmetric matrices `A` (..., n, n) to unit diagonal and decompose them.

    Returns the scale, the roots of the diagonal (1 where it is not positive); the ascending
    eigenvalues of A / (scale scale'); and the eigenvectors in columns.
    """
    if A.ndim < 2 or A.shape[-1] != A.shape[-2]:
        raise ValueError(f'{name} must be square, got shape {A.shape}')
    raise_for_invalid(name, 'finite', A, ~np.isfinite(A).all(axis=(-2, -1)))
    diagonal = np.einsum('...ii->...i', A)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    unit = A / (scale[..., :, None] * scale[..., None, :])
    asymmetry = np.abs(unit - np.swapaxes(unit, -1, -2))
    raise_for_invalid(name, 'symmetric', A, (asymmetry > 1e-9).any(axis=(-2, -1)))
    w, V = np.linalg.eigh(unit)
    raise_for_invalid(name, 'positive semidefinite', A,
                      (w < -1e-9).any(-1) | (diagonal < 0.0).any(-1))
    return scale, w, V


def ignoring_overflow() -> AbstractContextManager[None]:
    """Suppress overflow and invalid-value warnings: a diverging search gets an infinite cost."""
    return np.errstate(over='ignore', invalid='ignore')


PSEUDO_INVERSE_TOLERANCE = 1e-15
"""Eigenvalue, relative to the largest, below which a direction is due to rounding errors."""


def pseudo_inverse(A: FloatArray, tolerance: float = PSEUDO_INVERSE_TOLERANCE) -> FloatArray:
    """Pseudo-inverses of symmetric positive semidefinite matrices (n, k, k); NaN if not finite.

    The matrices are scaled to unit diagonal first, because units differ by decades; eigenvalues
    below `tolerance` times the largest are excluded. At full rank only the lower triangles are
    read.
    """
    A = np.ascontiguousarray(A, dtype=float)
    inverse: FloatArray = np.empty_like(A)
    # Cholesky factors take a hundredth of the time of eigenvalues.
    if core.inverses(A, MIN_PIVOT_ROOT, inverse):
        return inverse
    finite: BoolArray = np.all(np.isfinite(A), axis=(1, 2))
    if not finite.all():
        A = np.where(finite[:, None, None], A, np.eye(A.shape[1]))
    scale = np.sqrt(np.einsum('nii->ni', A))
    scale = np.where(scale > 0.0, scale, 1.0)
    w, V = np.linalg.eigh(A / (scale[:, :, None] * scale[:, None, :]))
    w = np.where(w > tolerance * w[:, -1:], w, np.inf)
    V = V / scale[:, :, None]
    with ignoring_overflow():
        inverse = (V / w[:, None, :]) @ np.swapaxes(V, 1, 2)
    inverse[~finite] = np.nan
    return inverse


MIN_PIVOT_ROOT = 1e-3
"""Minimum root of the pivots, at unit diagonal, for an inversion by the Cholesky factor."""


class MarginalWhitener:
    """Whitening of measurements y = C c + e, with standard normal c and e, by the inverse root of
    their covariance I + C C'.

    It is cheap, because the root is the identity outside the few directions spanned by C. `columns`
    (n_y, q) are C, the linear nuisance terms, each times the std of its coefficient.
    """

    def __init__(self, columns: FloatArray) -> None:
        self._U, singular_values, _ = np.linalg.svd(columns, full_matrices=False)
        self._singular_values = singular_values
        self._attenuation: FloatArray = 1.0 - 1.0 / np.sqrt(1.0 + singular_values**2)

    def __call__(self, A: FloatArray) -> FloatArray:
        """Return `A`, (..., n_y, k) or (n_y,), multiplied by the inverse root of I + C C'."""
        return A - (self._U * self._attenuation) @ (self._U.T @ A)

    def correction_factor(self, A: FloatArray) -> FloatArray:
        """Factor F(A) (q, k) of the low-rank correction in A' inv(I + C C') B = A'B - F(A)'
        F(B)."""
        gain: FloatArray = self._singular_values / np.sqrt(1.0 + self._singular_values**2)
        return gain[:, None] * (self._U.T @ A)
