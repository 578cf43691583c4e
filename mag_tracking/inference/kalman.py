"""Kalman update, batched over hypotheses.

The leading axis is always the hypothesis. A state is the n_t states of the
target, which every sensor sees, then n_own states of each sensor that only it
sees (its mounting angles; n_own may be 0), then three backgrounds of each
sensor (tesla, sensor frame): n_x = n_t + (n_own + 3) n_sensors. The update
takes the sensors one after the other, linearised at one common point, which
gives the numbers of the stacked update at a fraction of its cost.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.update_kernels import update_bank


@dataclass(frozen=True)
class Gains:
    """What an update did, sensor after sensor, as `inference.smoother` wants it.

    Of each sensor given those before it: z = W u whitens its innovation u, and x += G' z,
    P -= G' G, with G = W [H | I] P.
    """

    H: FloatArray
    """(n_hyp, n_sensors, 3, n_t + n_own) the derivative that was used."""
    n_own: int
    G: FloatArray
    """(n_hyp, n_sensors, 3, n_x); rows of missing axes are zero."""
    z: FloatArray
    """(n_hyp, n_sensors, 3)"""
    W: FloatArray
    """(n_hyp, n_sensors, 6) lower triangle, row by row."""

    @classmethod
    def of(cls, H: FloatArray, n_own: int, n_x: int) -> 'Gains':
        """To be filled by the update that has the derivative `H`, of `n_x` states."""
        n_hyp, n_sensors = H.shape[:2]
        return cls(H, n_own, np.empty((n_hyp, n_sensors, 3, n_x)), np.empty((n_hyp, n_sensors, 3)),
                   np.empty((n_hyp, n_sensors, 6)))


_NO_GAINS = np.empty((0, 0, 3, 0)), np.empty((0, 0, 3)), np.empty((0, 0, 6))


def update(x: FloatArray, P: FloatArray, y: FloatArray, h: FloatArray, H: FloatArray,
           C: FloatArray, inflation: FloatArray, x_lin: FloatArray | None = None, n_own: int = 0,
           gains: Gains | None = None) -> tuple[FloatArray, FloatArray]:
    """Measurement update of every hypothesis, in place.

    Parameters
    ----------
    x : (n_hyp, n_x), P : (n_hyp, n_x, n_x)
        Predicted states and covariances, C-contiguous; n_x as on top of this module.
    y : (n_sensors, 3) [T], sensor frame
        Measurement; NaN = axis or sensor missing.
    h : (n_hyp, n_sensors, 3) [T], sensor frame
        Field without the background, at the linearisation point.
    H : (n_hyp, n_sensors, 3, n_t + n_own)
        Its derivative by the target states and by the sensor's own.
    C : (n_sensors, 3, 3) [T^2]
        Noise covariance per sensor.
    inflation : (n_hyp, n_sensors) [T^2]
        Isotropic variance added to C (model error near the target).
    x_lin : (n_hyp, n_x), optional
        Linearisation point; the predicted state if left out.
    n_own : int
        States of each sensor between the target's and the backgrounds.
    gains : Gains, optional
        Is filled, for a backward pass.

    Returns
    -------
    log_likelihood : (n_hyp,)
        Log-density of the measurement given the past, in tesla^-n.
    nis : (n_hyp, n_sensors)
        Normalised innovation squared of each sensor, given those before it; as many degrees of
        freedom as it has axes present. Their sum is that of the stacked update.

    Raises
    ------
    ValueError
        A noise covariance is not positive definite, or the shapes do not fit.

    Source: T10 Alg. 2, measurement update; ICASSP11 eq. (9) for the inflation.
    """
    x_lin = x.copy() if x_lin is None else x_lin
    log_likelihood, nis = np.empty(len(x)), np.empty(inflation.shape)
    G, z, W = _NO_GAINS if gains is None else (gains.G, gains.z, gains.W)
    try:
        status = update_bank(x, P, x_lin, y, C, h, H, inflation, n_own, log_likelihood, nis,
                              G, z, W)
    except TypeError as error:
        raise ValueError(f'arrays have to be C-contiguous and of float64: {error}') from error
    if status == -2:
        raise ValueError('shapes that do not fit: ' + ', '.join(
            f'{name} {a.shape}' for name, a in (
                ('x', x), ('P', P), ('x_lin', x_lin), ('y', y), ('h', h), ('H', H), ('C', C),
                ('inflation', inflation))) + f' with n_own {n_own}')
    if status < 0:
        raise ValueError('a sensor\'s noise covariance is not positive definite')
    return log_likelihood, nis
