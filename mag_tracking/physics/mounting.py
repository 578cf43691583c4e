"""Fields measured by sensors with small orientation errors."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core


def rotated_fields(h: FloatArray, H: FloatArray, angles: FloatArray
                  ) -> tuple[FloatArray, FloatArray]:
    """Fields measured by sensors with small mounting errors, and their derivatives.

    `h` (n_hyp, n_sensors, 3) is in the nominal, the result in the actual sensor frame. `angles`
    [rad] are a in B_actual = B_nominal + a x B_nominal; for a sensor rotated by +b, a = -b. The
    derivative `H` (..., n_t) gains three columns for the angles. First order: the magnitude is too
    large by up to 1.5 % at 10 degrees, 3.4 % at 15. T10 section 6.3 describes the effect.
    """
    return core.rotated_fields(*(np.ascontiguousarray(a, dtype=float) for a in (h, H, angles)))
