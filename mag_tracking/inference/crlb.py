"""Fisher information, observability and the Cramer-Rao bound.

The model comes in as its Jacobians H = dh/dx, so that this file is mathematics
only. Ranks are judged on matrices brought to unit diagonal, as the units of the
states differ by decades; only `observability` leaves that to the caller. A row of
H that is wholly NaN is an axis that was not measured (a dipole's Jacobian on the
very sensor looks alike). Matrices that do not fit, are not finite, not symmetric
or not positive (semi)definite raise ValueError.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.matrices import (
    leading_broadcast,
    triangular_factor,
    unit_diagonal,
    whitened,
)

RANK_TOLERANCE = 1e-12
"""An eigenvalue below this share of the largest one counts as zero."""

_KERNEL_TOLERANCE = 1e-6
"""A state takes part in a kernel that reaches further than this along its axis."""

_K_DIPOLE = 1e-7
"""mu0 / 4 pi [T m / A]; the one in `physics` is not for this room to import."""


def information(H: ArrayLike, C: ArrayLike | None = None) -> FloatArray:
    """Fisher information of independent measurements, summed over all of them.

    Parameters
    ----------
    H : (..., n_y, n_x)
        Jacobians, n_y = 3 axes for a magnetometer; any leading axes (times, sensors).
    C : (..., n_y, n_y), optional
        Noise covariance of each measurement, broadcast against `H`, not read
        where the axis is missing; None if `H` is whitened.

    Returns (n_x, n_x); the unit of entry (i, j) is one over those of x_i and x_j.
    Source: TSP14 eq. (28), (40); T10 eq. (2.16), (5.7).
    """
    A = whitened(H, C)
    A = A.reshape(-1, A.shape[-1])
    return A.T @ A


@dataclass(frozen=True)
class Observability:
    """What measurements do and do not say of the states near one point."""

    eigenvalues: FloatArray
    """(n_x,), ascending, of the scaled information; zeros are rounding of either sign."""
    condition_number: float
    """Largest eigenvalue over smallest, T10 eq. (5.8); infinite where there is a kernel."""
    kernel: FloatArray
    """(n_x, k), in the states' own units; divided by the scale its columns are orthonormal."""
    unobservable: tuple[str, ...]
    """Names of the states that take part in the kernel."""

    @property
    def kernel_dimension(self) -> int:
        """How many directions of the state nothing is known about; 0 = observable."""
        return self.kernel.shape[1]


def observability(information: ArrayLike, names: Sequence[str],
                  scale: ArrayLike | None = None) -> Observability:
    """Local observability, from the eigenvalues of an information matrix.

    Parameters
    ----------
    information : (n_x, n_x)
    names : sequence of n_x str
        Of the states, for `unobservable`.
    scale : (n_x,), optional
        Typical size of each state in its unit. Eigenvalues, condition number
        and rank are then those of diag(scale) information diag(scale), the
        information about x / scale (T10 eq. (5.11)); else those of the matrix
        as it stands, which mean little where units differ by decades (metres
        beside backgrounds in tesla).

    Source: T10 sections 5.1-5.3; TSP14 section IV.
    """
    J = np.asarray(information, dtype=float)
    unit_diagonal('information', J)
    scale = np.ones(len(J)) if scale is None else np.asarray(scale, dtype=float)
    if len(names) != len(J) or scale.shape != (len(J),) or not np.all(scale > 0.0):
        raise ValueError(f'{len(J)} states need as many names and positive scales, '
                         f'got {list(names)} and {scale.tolist()}')
    w, V = np.linalg.eigh(scale[:, None] * J * scale)
    zero = w <= RANK_TOLERANCE * w[-1]
    return Observability(w, np.inf if zero.any() else w[-1] / w[0], scale[:, None] * V[:, zero],
                         tuple(names[i] for i in np.flatnonzero(_is_in_kernel(V[:, zero]))))


def bound(information: ArrayLike, prior: ArrayLike | None = None) -> FloatArray:
    """Cramer-Rao bound on the covariance of an estimate.

    Parameters
    ----------
    information : (n_x, n_x)
        Of the measurements.
    prior : (n_x, n_x), optional
        Information known before: diag(1 / std^2) for independent Gaussian
        states, `cpa_information`. On the diagonal 0 = nothing is known, inf =
        known exactly (its row and column are then not read).

    Returns
    -------
    (n_x, n_x)
        Inverse of the sum. Where that is singular, an unobservable state has
        variance inf and covariances NaN; the others have the values that any
        vanishing prior leads to. A state known exactly has zeros.

    Source: TSP14 eq. (42); MITRE12 eq. (18), (28), (32).
    """
    J = np.asarray(information, dtype=float)
    unit_diagonal('information', J)
    prior = leading_broadcast('prior', np.zeros(J.shape) if prior is None else prior, J.shape)
    known = np.isposinf(np.diagonal(prior))
    free = np.ix_(~known, ~known)
    unit_diagonal('prior', prior[free])
    scale, root, kernel = _inverse_root(J[free] + prior[free])
    P = root @ root.T / (scale[:, None] * scale)
    lost = _is_in_kernel(kernel)
    P[lost] = P[:, lost] = np.nan
    P[lost, lost] = np.inf
    covariance = np.zeros(J.shape)
    covariance[free] = P
    return covariance


def marginal(information: ArrayLike, keep: ArrayLike) -> FloatArray:
    """Information about some states when all the others are unknown as well.

    Parameters
    ----------
    information : (n_x, n_x)
    keep : (k,) int or (n_x,) bool
        The states of interest; the others (backgrounds, moments) are eliminated
        and need not be observable themselves.

    Returns
    -------
    (k, k)
        The Schur complement J_kk - J_ko J_oo^-1 J_ok, in the order of `keep`;
        zero about what `bound` finds unobservable.

    Raises ValueError also where a state is out of range or there twice.
    Source: TSP14 eq. (44): its inverse is that block of the bound.
    """
    J = np.asarray(information, dtype=float)
    try:
        kept = np.arange(len(J))[np.asarray(keep)]
    except IndexError as error:
        raise ValueError(f'keep does not fit {len(J)} states: {error}') from error
    if len(set(kept.tolist())) != kept.size:
        raise ValueError(f'keep names a state twice: {kept.tolist()}')
    scale, root, kernel = _inverse_root(J)
    # Not by subtraction: others that are hardly observable would leave rounding that looks
    # like information. First the directions (columns of U) that the kernel does not reach ...
    U, reach, _ = np.linalg.svd(kernel[kept])
    U = U[:, np.count_nonzero(reach > _KERNEL_TOLERANCE):]
    U = np.where(np.linalg.norm(U, axis=1, keepdims=True) > _KERNEL_TOLERANCE, U, 0.0)
    # ... then the inverse of the bound in them, U (U'PU)^-1 U'.
    R = triangular_factor((U.T @ root[kept]).T)
    W = scale[kept, None] * np.linalg.solve(R.T, U.T).T
    return W @ W.T


def cpa_information(r0: ArrayLike, v0: ArrayLike, std: float) -> FloatArray:
    """Information of a known range at the closest point of approach (CPA).

    Parameters
    ----------
    r0 : (3,) [m]
        Position at time zero, relative to the sensor that the range is counted from.
    v0 : (3,) [m/s]
    std : float [m]
        Standard deviation of the range; the source lets it vanish.

    Returns
    -------
    (9, 9)
        For the states [r0, v0, m]; of rank one.

    Raises ValueError also where the target stands still, and where `r0` is
    parallel to `v0`: the path then meets the sensor (TSP14 Proposition 2).
    Source: TSP14 eq. (35)-(37); the gradient by v0 printed in the proof of
    Proposition 2 lacks a minus sign.
    """
    r0, v0 = np.asarray(r0, dtype=float), np.asarray(v0, dtype=float)
    if r0.shape != (3,) or v0.shape != (3,):
        raise ValueError(f'r0 and v0 need shape (3,), got {r0.shape} and {v0.shape}')
    if not (np.isfinite(std) and std > 0.0 and v0 @ v0 > 0.0):
        raise ValueError(f'std has to be positive and v0 not zero, got {std}, {v0.tolist()}')
    t_cpa = -(r0 @ v0) / (v0 @ v0)
    r_cpa = r0 + t_cpa * v0
    size = np.linalg.norm(r_cpa)
    if not size > 1e-9 * np.linalg.norm(r0):
        raise ValueError(f'r0 = {r0.tolist()} is parallel to v0 = {v0.tolist()}: a CPA range of '
                         'zero says nothing of the scale (TSP14 Proposition 2)')
    gradient = np.concatenate([r_cpa, t_cpa * r_cpa, np.zeros(3)]) / (size * std)
    return np.outer(gradient, gradient)


def path_bound(F: ArrayLike, Q: ArrayLike, H: ArrayLike, C: ArrayLike | None,
               P0: ArrayLike) -> FloatArray:
    """Bound for filters along a given path: the covariance of the EKF linearised at the truth.

    Step k predicts with F[k], Q[k], then updates with H[k], C[k].

    Parameters
    ----------
    F, Q : (n_steps, n_x, n_x), or (n_x, n_x) for all steps
        Jacobian of the motion and covariance of its noise; Q may be singular.
    H : (n_steps, ..., n_y, n_x)
        Jacobians at the truth.
    C : (..., n_y, n_y) or None
        Noise covariances, broadcast against `H`; None if `H` is whitened.
    P0 : (n_x, n_x)
        Covariance before the first prediction; may be singular. Where it is
        that of the first measurement's time, give F[0] = I and Q[0] = 0.

    Returns the covariances (n_steps, n_x, n_x) after each update.
    Source: Tichavsky et al. 1998, without the mean over paths; T10 Alg. 2.
    """
    A = whitened(H, C)
    if A.ndim < 3:
        raise ValueError(f'H needs a leading axis of steps, got {np.shape(H)}')
    n_steps, n_x = len(A), A.shape[-1]
    F = leading_broadcast('F', F, (n_steps, n_x, n_x))
    Q = leading_broadcast('Q', Q, (n_steps, n_x, n_x))
    P = leading_broadcast('P0', P0, (n_x, n_x))
    unit_diagonal('P0', P)
    unit_diagonal('Q', Q)
    covariances = np.empty((n_steps, n_x, n_x))
    for k in range(n_steps):
        P = F[k] @ P @ F[k].T + Q[k]
        _, w, V = unit_diagonal(f'covariance of step {k}', P)
        # Not the scale, which is 1 where the variance is zero: what is known has to stay so.
        L = np.sqrt(np.diagonal(P))[:, None] * V * np.sqrt(np.maximum(w, 0.0))
        # P = L L' becomes L (I + L'A'A L)^-1 L'; by QR nothing is squared or subtracted.
        R = triangular_factor(np.vstack([A[k].reshape(-1, n_x) @ L, np.eye(n_x)]))
        G = np.linalg.solve(R.T, L.T)
        P = covariances[k] = G.T @ G
    return covariances


def snr(h: ArrayLike, C: ArrayLike) -> FloatArray:
    """Signal-to-noise ratio (of energies) h' C^-1 h of a field.

    Parameters
    ----------
    h : (..., n_y)
        Field without noise and background; NaN = axis not measured.
    C : (..., n_y, n_y)
        Noise covariance, same unit squared.

    Returns (...), the non-centrality in `detection_probability`; 0 without axes.
    Source: T10 eq. (5.14).
    """
    A = whitened(np.asarray(h, dtype=float)[..., None], C)
    energy: FloatArray = np.einsum('...ij,...ij->...', A, A)
    return energy


def snr_at_distance(moment: float | FloatArray, noise_std: float | FloatArray,
                    distance: float | FloatArray) -> FloatArray:
    """Signal-to-noise ratio of one sample of a dipole abeam; four times as much along its axis.

    Parameters
    ----------
    moment : float or array [A m^2]
        Its size: 300-600 for a car, 1800 for a truck (TSP14).
    noise_std : float or array [T]
        Of one axis, all alike; 1.1e-8 in TSP14.
    distance : float or array [m]

    Source: T10 eq. (5.20), (5.21). Its (5.23) prints |R|^2 where |R| is meant;
    moment and noise of its (5.22) are both too small by about 450.
    """
    return cast(FloatArray, (_K_DIPOLE * moment / (noise_std * distance**3))**2)


def snr_range(moment: float | FloatArray, noise_std: float | FloatArray,
              ratio: float | FloatArray) -> FloatArray:
    """Distance [m] where `snr_at_distance` is `ratio`; 9.2 gives T10 eq. (5.24).

    Along the dipole's axis it is larger by 2^(1/3).
    """
    distance: FloatArray = np.cbrt(_K_DIPOLE * moment / (noise_std * np.sqrt(ratio)))
    return distance


def _inverse_root(J: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scale, G with pseudo-inverse G G' and kernel basis, both of J at unit diagonal."""
    scale, w, V = unit_diagonal('information', J)
    zero = w <= RANK_TOLERANCE * w.max(initial=0.0)
    return scale, V[:, ~zero] / np.sqrt(w[~zero]), V[:, zero]


def _is_in_kernel(kernel: FloatArray) -> BoolArray:
    """Which states (n,) an orthonormal kernel basis (n, k) reaches."""
    reached: BoolArray = np.linalg.norm(kernel, axis=1) > _KERNEL_TOLERANCE
    return reached
