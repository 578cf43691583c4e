"""Fields measured by sensors with small orientation errors."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core


def rotated_fields(h: FloatArray, H: FloatArray, angles: FloatArray
                  ) -> tuple[FloatArray, FloatArray]:
    """Fields measured by sensors with small mounting errors, and their derivatives.

    Parameters
    ----------
    h : (n_hyp, n_sensors, 3) array, T, nominal sensor frame
        Field that sensors without mounting errors would measure.
    H : (n_hyp, n_sensors, 3, n_t) array
        Derivative of `h` with respect to the target state.
    angles : (n_hyp, n_sensors, 3) array, rad, sensor frame
        Vector a in B_actual = B_nominal + a x B_nominal. If a sensor is rotated by +b about one of
        its axes, the measured field is rotated by a = -b.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) array, T, actual sensor frame
        Measured field.
    H : (n_hyp, n_sensors, 3, n_t + 3) array
        Derivative with respect to the target state and the three angles of the sensor.

    Notes
    -----
    First-order approximation: the field magnitude is too large by up to 1.5 % at 10 degrees and
    3.4 % at 15 degrees.

    References
    ----------
    [T10]_ section 6.3 describes the effect of mounting errors.
    """
    return core.rotated_fields(*(np.ascontiguousarray(a, dtype=float) for a in (h, H, angles)))
