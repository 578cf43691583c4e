"""Flux density of magnetic dipoles at sensors, and its derivatives."""

import math

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core

MU0 = 4e-7 * math.pi
"""Vacuum permeability [T m/A], as in the cited papers."""
K_DIPOLE = core.K_DIPOLE
"""Constant mu0 / (4 pi) of the dipole field [T m/A]."""
sensor_fields = core.sensor_fields
"""Field (n_hyp, n_sensors, 3) [T, sensor frame] of dipoles, its derivative and its gradient.

`r` [m] and `m` [A m²] (n_hyp, n_dipoles, 3) are in the world frame; `dr_dx` and `dm_dx`
(n_hyp, n_dipoles, 3, n_t) are their derivatives with respect to the target state. Returns the
summed field of ICASSP11 eq. (9), its derivative (..., n_t), and the gradient (n_hyp, n_sensors)
[T/m], all NaN or infinite at the position of a sensor.

The gradient is the sum of mu0/(4 pi) ‖m‖ / ‖d‖^4 over the dipoles at distance d. A term times the
extent [m] of a body is the magnitude of the first neglected multipole order. Magnitudes are added,
not squares, because errors of adjacent dipoles of a body are correlated.
"""

rotated_fields = core.rotated_fields
"""Fields measured by sensors with small mounting errors, and their derivatives.

`h` (n_hyp, n_sensors, 3) is in the nominal, the result in the actual sensor frame. `angles` [rad]
are a in B_actual = B_nominal + a x B_nominal; for a sensor rotated by +b, a = -b. The derivative
`H` (..., n_t) gains three columns for the angles. First order: the magnitude is too large by up to
1.5 % at 10 degrees, 3.4 % at 15. T10 section 6.3 describes the effect.
"""


def _broadcast_pair(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Broadcast `r` and `m` to contiguous arrays of a common shape (..., 3)."""
    r, m = np.broadcast_arrays(np.asarray(r, dtype=float), np.asarray(m, dtype=float))
    return np.ascontiguousarray(r), np.ascontiguousarray(m)


def dipole_field(r: ArrayLike, m: ArrayLike) -> FloatArray:
    """Flux density (..., 3) [T] of a point dipole `m` [A m²], NaN at r = 0; `r` [m] points from the
    source to the sensor, TSP14 eq. (2)."""
    return core.dipole_field(*_broadcast_pair(r, m))


def dipole_jacobians(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `dipole_field` by `r` (..., 3, 3) [T/m] and by `m` [T/(A m²)], NaN at r = 0.

    Both are symmetric; the derivative by the source position is minus the first. TSP14 eq. (30a),
    (30b), with the factor mu0/(4 pi).
    """
    return core.dipole_jacobians(*_broadcast_pair(r, m))
