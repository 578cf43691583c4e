"""Sensors that are not turned quite as the network says."""

import numpy as np

from mag_tracking.physics.motion import cross_matrix


def turned_fields(h, H, angles):
    """Fields as sensors see them that are turned by small angles.

    Parameters
    ----------
    h : (n_hyp, n_sensors, 3) [T], sensor frame as stated
    H : (n_hyp, n_sensors, 3, n_t)
        Its derivative by the target state.
    angles : (n_hyp, n_sensors, 3) [rad], sensor frame
        Rotation vectors from the frame as stated to the frame as it is.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) [T], sensor frame as it is
    H : (n_hyp, n_sensors, 3, n_t + 3 n_sensors)
        Derivative by the target state and by the angles of all sensors.

    To first order, h + a x h: at ten degrees its length is 1.5 % off.
    Source: the small-angle rotation; T10 section 6.3 for why it is needed.
    """
    n_hyp, n_sensors, _, n_t = H.shape
    turn, by_angle = cross_matrix(angles), -cross_matrix(h)
    out = np.zeros((n_hyp, n_sensors, 3, n_t + 3 * n_sensors))
    out[..., :n_t] = H + turn @ H
    for j in range(n_sensors):
        out[:, j, :, n_t + 3 * j:n_t + 3 * j + 3] = by_angle[:, j]
    return h + (turn @ h[..., None])[..., 0], out
