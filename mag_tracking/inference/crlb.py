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
from mag_tracking.inference.matrices import leading_broadcast, unit_diagonal, whitened

RANK_TOLERANCE = 1e-12
"""Eigenvalues at or below this fraction of the largest eigenvalue count as zero."""
_KERNEL_TOLERANCE = 1e-6
"""Component of a kernel along the axis of a state above which the state is unobservable."""
_K_DIPOLE = 1e-7
"""mu0 / (4 pi) [T m/A]; not imported, because `inference` does not depend on `physics`."""


def information(H: ArrayLike, C: ArrayLike | None = None) -> FloatArray:
    """Fisher information (n_x, n_x) summed over independent measurements with Jacobians `H`.

    `H` is (..., n_y, n_x); a row of NaN is an unmeasured axis. The noise covariances `C`
    (..., n_y, n_y) broadcast against `H`; None if `H` is whitened. TSP14 eq. (28), (40);
    T10 eq. (2.16), (5.7).
    """
    A = whitened(H, C)
    A = A.reshape(-1, A.shape[-1])
    return A.T @ A


@dataclass(frozen=True)
class Observability:
    """Observability of the states near the point at which a model is linearised."""

    eigenvalues: FloatArray
    """Ascending eigenvalues of the scaled information, (n_x,); zeros are subject to rounding."""
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
    """Local observability of states from the eigenvalues of their Fisher information.

    Eigenvalues, condition number and rank refer to the states divided by `scale` (n_x,), their
    typical magnitudes (default 1). T10 sections 5.1-5.3 and eq. (5.11); TSP14 section IV.
    """
    J = np.asarray(information, dtype=float)
    unit_diagonal('information', J)
    scale = np.ones(len(J)) if scale is None else np.asarray(scale, dtype=float)
    w, V = np.linalg.eigh(scale[:, None] * J * scale)
    zero = w <= RANK_TOLERANCE * w[-1]
    return Observability(w, np.inf if zero.any() else w[-1] / w[0], scale[:, None] * V[:, zero],
                         tuple(names[i] for i in np.flatnonzero(_is_in_kernel(V[:, zero]))))


def bound(information: ArrayLike, prior: ArrayLike | None = None) -> FloatArray:
    """Cramér-Rao bound (n_x, n_x), the inverse of the total information of measurements and prior.

    On the diagonal of `prior`, 0 means no prior and inf an exactly known state, whose entries in
    the bound are zero. If the total is singular, an unobservable state has variance inf and
    covariances NaN; the other entries are the limits for a vanishing prior. TSP14 eq. (42);
    MITRE12 eq. (18), (28), (32).
    """
    J = np.asarray(information, dtype=float)
    unit_diagonal('information', J)
    prior = leading_broadcast('prior', np.zeros(J.shape) if prior is None else prior, J.shape)
    is_exact = np.isposinf(np.diagonal(prior))
    free = np.ix_(~is_exact, ~is_exact)
    unit_diagonal('prior', prior[free])
    scale, w, V = unit_diagonal('information', J[free] + prior[free])
    zero = w <= RANK_TOLERANCE * w.max(initial=0.0)
    root, kernel = V[:, ~zero] / np.sqrt(w[~zero]), V[:, zero]
    P = root @ root.T / (scale[:, None] * scale)
    is_unobservable = _is_in_kernel(kernel)
    P[is_unobservable] = P[:, is_unobservable] = np.nan
    P[is_unobservable, is_unobservable] = np.inf
    covariance = np.zeros(J.shape)
    covariance[free] = P
    return covariance


def cpa_information(r0: ArrayLike, v0: ArrayLike, std: float) -> FloatArray:
    """Fisher information (9, 9) about [r0, v0, m] of a known range at the CPA (closest approach).

    `r0` [m] is the position at time zero relative to the sensor, `std` [m] that of the range
    (zero in TSP14). A range of zero, if `r0` is parallel to `v0`, does not make the scale
    observable (TSP14 Proposition 2). TSP14 eq. (35)-(37); the gradient with respect to v0 printed
    in the proof of Proposition 2 lacks a minus sign.
    """
    r0, v0 = np.asarray(r0, dtype=float), np.asarray(v0, dtype=float)
    t_cpa = -(r0 @ v0) / (v0 @ v0)
    r_cpa = r0 + t_cpa * v0
    gradient = np.concatenate([r_cpa, t_cpa * r_cpa, np.zeros(3)]) / (np.linalg.norm(r_cpa) * std)
    return np.outer(gradient, gradient)


def path_bound(F: ArrayLike, Q: ArrayLike, H: ArrayLike, C: ArrayLike | None,
               P0: ArrayLike) -> FloatArray:
    """Posterior Cramér-Rao bound (n_steps, n_x, n_x) of a filter along a given path.

    It is the covariance, after each update, of an extended Kalman filter linearised at the truth
    ([Tichavsky98]_ without the mean over paths; T10 Alg. 2). Step k predicts with F[k] and Q[k]
    (or a common F, Q), then updates with H[k] and C[k]; C is None if H is whitened. Q and P0 may be
    singular. If P0 refers to the first measurement, pass F[0] = I and Q[0] = 0.
    """
    A = whitened(H, C)
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
        # The type stub of NumPy lists only the pair (Q, R).
        R = cast(FloatArray, np.linalg.qr(np.vstack([A[k].reshape(-1, n_x) @ L, np.eye(n_x)]),
                                          mode='r'))
        G = np.linalg.solve(R.T, L.T)
        P = covariances[k] = G.T @ G
    return covariances


def snr(h: ArrayLike, C: ArrayLike) -> FloatArray:
    """Signal-to-noise energy ratio h' C^-1 h of a noise-free field (..., n_y), T10 eq. (5.14).

    It is the non-centrality parameter of `detection_theory.detection_probability`.
    """
    A = whitened(np.asarray(h, dtype=float)[..., None], C)
    energy: FloatArray = np.einsum('...ij,...ij->...', A, A)
    return energy


def snr_range(moment: float | FloatArray, noise_std: float | FloatArray,
              ratio: float | FloatArray) -> FloatArray:
    """Distance [m] across the axis of a dipole at which one sample has the energy `ratio`.

    Along the axis it is larger by a factor of 2^(1/3). `moment` is in A m² (300-600 for a car, 1800
    for a truck), `noise_std` in T per axis (1.1e-8 in TSP14); `ratio` is 9.2 in T10. T10
    eq. (5.20)-(5.24): eq. (5.23) prints the squared norm of R instead of the norm; moment and noise
    in eq. (5.22) are too small by a factor of about 450.
    """
    return np.cbrt(_K_DIPOLE * moment / (noise_std * np.sqrt(ratio)))


def _is_in_kernel(kernel: FloatArray) -> BoolArray:
    """Flag the states (n,) with a component in a kernel, given its orthonormal basis (n, k)."""
    in_kernel: BoolArray = np.linalg.norm(kernel, axis=1) > _KERNEL_TOLERANCE
    return in_kernel
