"""Fisher information, observability and the Cramér-Rao bound.

The model is given by its Jacobians H = dh/dx. A row of H that is all NaN is an axis that was not
measured; a dipole located at the sensor also gives such rows. Ranks are determined on matrices
scaled to unit diagonal, because the units of the states differ by decades; only `observability`
leaves the scale to the caller. Matrices that do not match in shape, are not finite, not symmetric
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
"""Eigenvalues at or below this fraction of the largest eigenvalue count as zero."""

_KERNEL_TOLERANCE = 1e-6
"""Component of a kernel along the axis of a state above which the state is unobservable."""

_K_DIPOLE = 1e-7
"""mu0 / (4 pi) [T m/A]; not imported, because `inference` does not depend on `physics`."""


def information(H: ArrayLike, C: ArrayLike | None = None) -> FloatArray:
    """Fisher information of independent measurements, summed over all measurements.

    Parameters
    ----------
    H : (..., n_y, n_x) array
        Jacobians; n_y = 3 axes for a magnetometer, any leading axes (times, sensors). A row of NaN
        is an axis that was not measured.
    C : (..., n_y, n_y) array, optional
        Noise covariance of each measurement; leading axes broadcast against `H`. Entries of missing
        axes are not read. Omit if `H` is whitened.

    Returns
    -------
    (n_x, n_x) array
        Entry (i, j) has the reciprocal unit of x_i x_j.

    References
    ----------
    [TSP14]_ eq. (28), (40); [T10]_ eq. (2.16), (5.7).
    """
    A = whitened(H, C)
    A = A.reshape(-1, A.shape[-1])
    return A.T @ A


@dataclass(frozen=True)
class Observability:
    """Observability of the states near the point at which a model is linearised."""

    eigenvalues: FloatArray
    """Eigenvalues of the scaled information, (n_x,), ascending; zeros are subject to rounding of
    either sign."""
    condition_number: float
    """Largest over smallest eigenvalue, T10 eq. (5.8); infinite if there is a kernel."""
    kernel: FloatArray
    """Basis of the unobservable subspace, (n_x, k), in the units of the states; its columns are
    orthonormal after division by the scale."""
    unobservable: tuple[str, ...]
    """Names of the states with a component in the kernel."""

    @property
    def kernel_dimension(self) -> int:
        """Number of unobservable directions of the state; 0 if all states are observable."""
        return self.kernel.shape[1]


def observability(information: ArrayLike, names: Sequence[str],
                  scale: ArrayLike | None = None) -> Observability:
    """Local observability of states, from the eigenvalues of their information matrix.

    Parameters
    ----------
    information : (n_x, n_x) array
        Fisher information.
    names : sequence of str
        Names of the n_x states.
    scale : (n_x,) array, optional
        Typical magnitude of each state, in its unit. Eigenvalues, condition number and rank
        refer to diag(scale) information diag(scale), the information about x / scale. Default: 1;
        a scale is required if the units differ by decades (metres and tesla).

    Returns
    -------
    Observability

    Raises
    ------
    ValueError
        If the number of names or scales is not n_x, a scale is not positive, or the matrix is
        invalid.

    References
    ----------
    [T10]_ sections 5.1-5.3 and eq. (5.11); [TSP14]_ section IV.
    """
    J = np.asarray(information, dtype=float)
    unit_diagonal('information', J)
    scale = np.ones(len(J)) if scale is None else np.asarray(scale, dtype=float)
    if len(names) != len(J) or scale.shape != (len(J),) or not np.all(scale > 0.0):
        raise ValueError(f'expected names and positive scales of {len(J)} states, '
                         f'got {list(names)} and {scale.tolist()}')
    w, V = np.linalg.eigh(scale[:, None] * J * scale)
    zero = w <= RANK_TOLERANCE * w[-1]
    return Observability(w, np.inf if zero.any() else w[-1] / w[0], scale[:, None] * V[:, zero],
                         tuple(names[i] for i in np.flatnonzero(_is_in_kernel(V[:, zero]))))


def bound(information: ArrayLike, prior: ArrayLike | None = None) -> FloatArray:
    """Cramér-Rao bound on the covariance of an estimate.

    Parameters
    ----------
    information : (n_x, n_x) array
        Fisher information of the measurements.
    prior : (n_x, n_x) array, optional
        Prior information: diag(1 / std^2) for independent Gaussian states, or `cpa_information`.
        On the diagonal, 0 means that there is no prior, and inf that the state is exactly known;
        the other entries of the row and column of an exactly known state are not read.

    Returns
    -------
    (n_x, n_x) array
        Inverse of the total information. If the total is singular, an unobservable state has
        variance inf and covariances NaN; the entries of the other states are the limits for a
        vanishing prior. The entries of an exactly known state are zero.

    References
    ----------
    [TSP14]_ eq. (42); [MITRE12]_ eq. (18), (28), (32).
    """
    J = np.asarray(information, dtype=float)
    unit_diagonal('information', J)
    prior = leading_broadcast('prior', np.zeros(J.shape) if prior is None else prior, J.shape)
    is_exact = np.isposinf(np.diagonal(prior))
    free = np.ix_(~is_exact, ~is_exact)
    unit_diagonal('prior', prior[free])
    scale, root, kernel = _inverse_root(J[free] + prior[free])
    P = root @ root.T / (scale[:, None] * scale)
    is_unobservable = _is_in_kernel(kernel)
    P[is_unobservable] = P[:, is_unobservable] = np.nan
    P[is_unobservable, is_unobservable] = np.inf
    covariance = np.zeros(J.shape)
    covariance[free] = P
    return covariance


def marginal(information: ArrayLike, keep: ArrayLike) -> FloatArray:
    """Fisher information about some states if all other states are unknown.

    Parameters
    ----------
    information : (n_x, n_x) array
        Fisher information.
    keep : (k,) int array or (n_x,) bool array
        States of interest. The other states (backgrounds, moments) are eliminated and need not be
        observable.

    Returns
    -------
    (k, k) array
        Schur complement J_kk - J_ko J_oo^-1 J_ok, in the order of `keep`; its inverse is the
        corresponding block of the bound. Zero in directions that `bound` finds unobservable.

    Raises
    ------
    ValueError
        If an index in `keep` is out of range or occurs twice, or if the matrix is invalid.

    References
    ----------
    [TSP14]_ eq. (44).
    """
    J = np.asarray(information, dtype=float)
    try:
        selected = np.arange(len(J))[np.asarray(keep)]
    except IndexError as error:
        raise ValueError(f'keep is not valid for {len(J)} states: {error}') from error
    if len(set(selected.tolist())) != selected.size:
        raise ValueError(f'keep contains a state twice: {selected.tolist()}')
    scale, root, kernel = _inverse_root(J)
    # The complement is not computed by subtraction: eliminated states that are barely observable
    # would leave rounding errors that look like information. First find the directions (columns
    # of U) outside the kernel ...
    U, kernel_components, _ = np.linalg.svd(kernel[selected])
    U = U[:, np.count_nonzero(kernel_components > _KERNEL_TOLERANCE):]
    U = np.where(np.linalg.norm(U, axis=1, keepdims=True) > _KERNEL_TOLERANCE, U, 0.0)
    # ... then invert the bound in these directions, U (U'PU)^-1 U'.
    R = triangular_factor((U.T @ root[selected]).T)
    W = scale[selected, None] * np.linalg.solve(R.T, U.T).T
    return W @ W.T


def cpa_information(r0: ArrayLike, v0: ArrayLike, std: float) -> FloatArray:
    """Fisher information of a known range at the closest point of approach (CPA).

    Parameters
    ----------
    r0 : (3,) array, m
        Position of the target at time zero, relative to the sensor from which the range is
        measured.
    v0 : (3,) array, m/s
        Velocity of the target.
    std : float, m
        Standard deviation of the range; TSP14 uses the limit of zero.

    Returns
    -------
    (9, 9) array
        Information about the states [r0, v0, m]; rank one.

    Raises
    ------
    ValueError
        If `std` is not positive, `v0` is zero, or `r0` is parallel to `v0`. In the last case the
        path goes through the sensor (TSP14 Proposition 2).

    Notes
    -----
    The gradient with respect to v0 printed in the proof of TSP14 Proposition 2 lacks a minus sign.

    References
    ----------
    [TSP14]_ eq. (35)-(37).
    """
    r0, v0 = np.asarray(r0, dtype=float), np.asarray(v0, dtype=float)
    if r0.shape != (3,) or v0.shape != (3,):
        raise ValueError(f'r0 and v0 must have shape (3,), got {r0.shape} and {v0.shape}')
    if not (np.isfinite(std) and std > 0.0 and v0 @ v0 > 0.0):
        raise ValueError('std must be positive and finite and v0 non-zero, got '
                         f'{std} and {v0.tolist()}')
    t_cpa = -(r0 @ v0) / (v0 @ v0)
    r_cpa = r0 + t_cpa * v0
    cpa_range = np.linalg.norm(r_cpa)
    if not cpa_range > 1e-9 * np.linalg.norm(r0):
        raise ValueError(f'r0 = {r0.tolist()} is parallel to v0 = {v0.tolist()}: a CPA range of '
                         'zero does not make the scale observable (TSP14 Proposition 2)')
    gradient = np.concatenate([r_cpa, t_cpa * r_cpa, np.zeros(3)]) / (cpa_range * std)
    return np.outer(gradient, gradient)


def path_bound(F: ArrayLike, Q: ArrayLike, H: ArrayLike, C: ArrayLike | None,
               P0: ArrayLike) -> FloatArray:
    """Posterior Cramér-Rao bound of a filter along a given path.

    The bound is the covariance of an extended Kalman filter that is linearised at the truth. Step k
    predicts with F[k] and Q[k], then updates with H[k] and C[k].

    Parameters
    ----------
    F : (n_steps, n_x, n_x) or (n_x, n_x) array
        Jacobian of the motion, per step or common to all steps.
    Q : (n_steps, n_x, n_x) or (n_x, n_x) array
        Covariance of the process noise; may be singular.
    H : (n_steps, ..., n_y, n_x) array
        Measurement Jacobians at the truth.
    C : (..., n_y, n_y) array or None
        Noise covariances, broadcast against `H`; None if `H` is whitened.
    P0 : (n_x, n_x) array
        Covariance before the first prediction; may be singular. If it refers to the time of the
        first measurement, pass F[0] = I and Q[0] = 0.

    Returns
    -------
    (n_steps, n_x, n_x) array
        Covariance after each update.

    Raises
    ------
    ValueError
        If `H` has no axis of steps, or a matrix is invalid.

    References
    ----------
    [Tichavsky98]_, without the mean over paths; [T10]_ Alg. 2.
    """
    A = whitened(H, C)
    if A.ndim < 3:
        raise ValueError(f'H requires a leading axis of steps, got {np.shape(H)}')
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
        # The scale of `unit_diagonal` is 1 at zero variance; an exactly known state must remain so.
        L = np.sqrt(np.diagonal(P))[:, None] * V * np.sqrt(np.maximum(w, 0.0))
        # P = L L' becomes L (I + L'A'A L)^-1 L'; QR avoids squares and subtractions.
        R = triangular_factor(np.vstack([A[k].reshape(-1, n_x) @ L, np.eye(n_x)]))
        G = np.linalg.solve(R.T, L.T)
        P = covariances[k] = G.T @ G
    return covariances


def snr(h: ArrayLike, C: ArrayLike) -> FloatArray:
    """Signal-to-noise energy ratio h' C^-1 h of a field.

    The ratio is the non-centrality parameter of `detection_theory.detection_probability`.

    Parameters
    ----------
    h : (..., n_y) array
        Field without noise and background; NaN for an unmeasured axis.
    C : (..., n_y, n_y) array
        Noise covariance, in the squared unit of `h`.

    Returns
    -------
    (...) array
        0 if no axis is measured.

    References
    ----------
    [T10]_ eq. (5.14).
    """
    A = whitened(np.asarray(h, dtype=float)[..., None], C)
    energy: FloatArray = np.einsum('...ij,...ij->...', A, A)
    return energy


def snr_at_distance(moment: float | FloatArray, noise_std: float | FloatArray,
                    distance: float | FloatArray) -> FloatArray:
    """Signal-to-noise ratio of one sample at a distance from a dipole, perpendicular to its axis.

    Along the axis of the dipole the ratio is four times larger.

    Parameters
    ----------
    moment : float or array, A m²
        Magnitude of the moment: 300-600 for a car, 1800 for a truck (TSP14).
    noise_std : float or array, T
        Noise standard deviation of one axis, equal on all axes; 1.1e-8 in TSP14.
    distance : float or array, m

    Returns
    -------
    (...) array

    Notes
    -----
    T10 eq. (5.23) prints the squared norm of R instead of the norm. Moment and noise in T10 eq.
    (5.22) are both too small by a factor of about 450.

    References
    ----------
    [T10]_ eq. (5.20), (5.21).
    """
    return cast(FloatArray, (_K_DIPOLE * moment / (noise_std * distance**3))**2)


def snr_range(moment: float | FloatArray, noise_std: float | FloatArray,
              ratio: float | FloatArray) -> FloatArray:
    """Distance at which `snr_at_distance` has a given value.

    Along the axis of the dipole the distance is larger by a factor of 2^(1/3).

    Parameters
    ----------
    moment : float or array, A m²
        Magnitude of the dipole moment.
    noise_std : float or array, T
        Noise standard deviation of one axis.
    ratio : float or array
        Signal-to-noise ratio; 9.2 in T10.

    Returns
    -------
    (...) array, m

    References
    ----------
    [T10]_ eq. (5.24).
    """
    distance: FloatArray = np.cbrt(_K_DIPOLE * moment / (noise_std * np.sqrt(ratio)))
    return distance


def _inverse_root(J: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scale J to unit diagonal, and decompose the scaled matrix.

    Returns the scale (n,), a root G (n, rank) of the pseudo-inverse G G' of the scaled matrix, and
    an orthonormal basis of its kernel (n, n - rank).
    """
    scale, w, V = unit_diagonal('information', J)
    zero = w <= RANK_TOLERANCE * w.max(initial=0.0)
    return scale, V[:, ~zero] / np.sqrt(w[~zero]), V[:, zero]


def _is_in_kernel(kernel: FloatArray) -> BoolArray:
    """Flag the states (n,) with a component in a kernel, given its orthonormal basis (n, k)."""
    in_kernel: BoolArray = np.linalg.norm(kernel, axis=1) > _KERNEL_TOLERANCE
    return in_kernel
