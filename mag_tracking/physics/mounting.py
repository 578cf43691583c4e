"""Sensors that are not turned quite as the network says."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.compiled import compiled_when_used


@compiled_when_used(
    'void(float64[:,:,::1], float64[:,:,:,::1], float64[:,:,:], float64[:,:,::1], '
    'float64[:,:,:,::1])', error_model='numpy', fastmath={'contract'})
def _turned_fields(h: FloatArray, H: FloatArray, angles: FloatArray, out_h: FloatArray,
                   out_H: FloatArray) -> None:
    """Loop of `turned_fields` over hypotheses and sensors."""
    n_hyp, n_sensors, _, n_t = H.shape
    for p in range(n_hyp):
        for j in range(n_sensors):
            a0, a1, a2 = angles[p, j, 0], angles[p, j, 1], angles[p, j, 2]
            h0, h1, h2 = h[p, j, 0], h[p, j, 1], h[p, j, 2]
            out_h[p, j, 0] = h0 + a1 * h2 - a2 * h1
            out_h[p, j, 1] = h1 + a2 * h0 - a0 * h2
            out_h[p, j, 2] = h2 + a0 * h1 - a1 * h0
            for c in range(n_t):
                c0, c1, c2 = H[p, j, 0, c], H[p, j, 1, c], H[p, j, 2, c]
                out_H[p, j, 0, c] = c0 + a1 * c2 - a2 * c1
                out_H[p, j, 1, c] = c1 + a2 * c0 - a0 * c2
                out_H[p, j, 2, c] = c2 + a0 * c1 - a1 * c0
            # a x h = -[h]x a
            out_H[p, j, 0, n_t], out_H[p, j, 0, n_t + 1], out_H[p, j, 0, n_t + 2] = 0.0, h2, -h1
            out_H[p, j, 1, n_t], out_H[p, j, 1, n_t + 1], out_H[p, j, 1, n_t + 2] = -h2, 0.0, h0
            out_H[p, j, 2, n_t], out_H[p, j, 2, n_t + 1], out_H[p, j, 2, n_t + 2] = h1, -h0, 0.0


def turned_fields(h: FloatArray, H: FloatArray, angles: FloatArray
                  ) -> tuple[FloatArray, FloatArray]:
    """Fields as sensors see them that are turned by small angles.

    Parameters
    ----------
    h : (n_hyp, n_sensors, 3) [T], sensor frame as stated
    H : (n_hyp, n_sensors, 3, n_t)
        Its derivative by the target state.
    angles : (n_hyp, n_sensors, 3) [rad], sensor frame
        a in B_actual = B_stated + a x B_stated. A sensor that was turned by +b
        about one of its axes sees the field turned back: a = -b.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) [T], sensor frame as it is
    H : (n_hyp, n_sensors, 3, n_t + 3)
        Derivative by the target state and by the sensor's own three angles.

    First order in the angle: at ten degrees the field's length is 1.5 % off,
    at fifteen 3.4 %. Source: the small-angle rotation; T10 section 6.3 for
    why it is needed.
    """
    n_hyp, n_sensors, _, n_t = H.shape
    out_h, out_H = np.empty((n_hyp, n_sensors, 3)), np.empty((n_hyp, n_sensors, 3, n_t + 3))
    _turned_fields(np.ascontiguousarray(h), np.ascontiguousarray(H), angles, out_h, out_H)
    return out_h, out_H
