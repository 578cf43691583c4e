"""Sensors that are not turned quite as the network says."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core


def rotated_fields(h: FloatArray, H: FloatArray, angles: FloatArray
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
    return core.rotated_fields(*(np.ascontiguousarray(a, dtype=float) for a in (h, H, angles)))
