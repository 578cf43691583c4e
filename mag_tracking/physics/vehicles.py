"""Source model of vehicles: a point target, or a row of dipoles along the heading."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import elliprd

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core
from mag_tracking.physics.dipole import MU0
from mag_tracking.physics.sources import Dipoles, constant_velocity, decaying_turn


def demagnetisation_factors(aspect: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Demagnetisation factors L1 along and L2 = (1 - L1)/2 across the axis of an ellipsoid.

    `aspect` is the semi-axis of revolution over the transverse one. L1 is 1/3 for a sphere; it
    approaches 0 for a needle (`aspect` above 1) and 1 for a disk.

    Instead of the closed form, 0/0 for a sphere, the underlying integral a b c/2 ∫ ds/((s + a^2)
    sqrt(...)) is evaluated as Carlson's R_D. MITRE12 eq. (A.2)-(A.4) with an error: t2 must be m -
    (t1 + 1)/m; the printed m - t1 - 1 gives L1 + 2 L2 = 0.49 at m = 2 instead of 1.
    """
    aspect = np.asarray(aspect, dtype=float)
    if not np.all((aspect >= 1e-100) & (aspect <= 1e100)):
        raise ValueError(f'aspect must be between 1e-100 and 1e100, got {aspect.tolist()}')
    squared_aspect = aspect * aspect
    return (aspect / 3 * elliprd(1.0, 1.0, squared_aspect),
            aspect / 3 * elliprd(1.0, squared_aspect, 1.0))


def ellipsoid_moment(semi_axes: Sequence[float] | FloatArray, mu_r: float, heading: ArrayLike,
                     earth_field: ArrayLike) -> FloatArray:
    """Moment (..., 3) [A m²] that the Earth's field induces in a permeable ellipsoid of revolution.

    The semi-axes (revolution, transverse) [m] are half the length and width of a vehicle; the axis
    of revolution is horizontal along `heading` [rad, from x to y]. `mu_r` is 11 in MITRE12 Table 1;
    `earth_field` is B0 [T], and vectors are in the world frame.

    MITRE12 eq. (A.1), (A.5)-(A.7). There, B0/mu0 is printed as 2.5 B0/pi for B0 in microtesla, the
    moment is in the vehicle frame, the course is clockwise from north, and the vertical field in
    (A.6) is positive downwards although the third axis points up.
    """
    a, b = semi_axes
    if not (0.0 < a < math.inf and 0.0 < b < math.inf):
        raise ValueError(f'semi_axes must be positive and finite, got {a}, {b}')
    if not 1.0 <= mu_r < math.inf:
        raise ValueError(f'mu_r must be at least 1 and finite, got {mu_r}')
    earth_field, heading = np.asarray(earth_field, dtype=float), np.asarray(heading, dtype=float)
    if earth_field.shape[-1:] != (3,):
        raise ValueError('earth_field requires a last axis of length 3, got shape '
                         f'{earth_field.shape}')
    volume = 4.0 / 3.0 * math.pi * a * b * b
    kappa = mu_r - 1.0
    p1, p2 = (volume * kappa / (1.0 + kappa * L) for L in demagnetisation_factors(a / b))
    axis = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
    axial_field = np.sum(axis * earth_field, axis=-1, keepdims=True)
    moment: FloatArray = (p2 * earth_field + (p1 - p2) * axial_field * axis) / MU0
    return moment


MAX_TURN_RATE = 1.0
"""Maximum standard deviation of the turn rate [rad/s], which limits the rate of slow vehicles."""


@dataclass(frozen=True)
class RowVehicle:
    """A point target, or a row of equidistant dipoles along the heading with an unknown length.

    State: position r of the centre of the row [m], velocity v [m/s], hard iron moment m0 of each
    dipole [A m²] from tail to head in the vehicle frame (x forward, z up), diagonal of the soft
    iron tensor D of the whole vehicle [m³] in the vehicle frame, length L [m]
    (not for a single dipole), optional turn rate w [rad/s]. Without w there are 10 + 3 d components
    for d > 1 dipoles, and 12 for a single dipole. Moment and position of dipole i = 1 .. d are::

        m_i = R (m0_i + D R^T B0/(d mu0)) with R = Rz(heading),
        r_i = r + (i - (d+1)/2) L/(d-1) heading

    D depends on the axis because sheets and axles are easier to magnetise along their length than
    across (MITRE12 eq. (A.5)); with equal components it is the scalar of TSP14 eq. (10), (16). The
    induced moment is (D/mu0) B0 as in ICASSP11 eq. (8), not (3D/mu0) B0 as in T10.

    The heading is the direction of the horizontal velocity; roll, pitch and slip are zero. At zero
    speed, the heading is atan2(0, 0) = 0, and its derivative is set to zero. With one dipole, or
    L = 0, this is the point target of ICASSP11 eq. (4)-(8). A row of negative length equals a row
    of positive length with the opposite order of dipoles.
    """

    earth_field: FloatArray
    """Flux density B0 of the Earth's field, (3,) T, world frame. Zeros disable soft iron."""
    acceleration_density: FloatArray
    """Power spectral density of the acceleration, per axis, (3,) m²/s³."""
    moment_drift: float = 0.0
    """Random walk of the total hard iron moment, 1/s^0.5 per axis, relative to the magnitude of the
    hard and soft iron moments."""
    difference_drift: float = 0.0
    """Random walk of the difference between a hard iron moment and the mean of the row, 1/s^0.5 per
    axis, normalised as `moment_drift`."""
    n_dipoles: int = 3
    turn_acceleration: float = 0.0
    """Standard deviation of the lateral acceleration of turning vehicles, m/s². Zero removes the
    turn rate from the state."""
    turn_time: float = 1.5
    """Correlation time of the turn rate (first-order Gauss-Markov), s."""

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return ('x', 'y', 'z', 'vx', 'vy', 'vz',
                *(f'm{i + 1}{axis}' for i in range(self.n_dipoles) for axis in 'xyz'),
                'Dx', 'Dy', 'Dz',
                *(('L',) if self.n_dipoles > 1 else ()),
                *(('w',) if self.turn_acceleration else ()))

    @cached_property
    def field_strength(self) -> FloatArray:
        """Magnetic field strength B0/mu0 of the Earth, (3,) A/m, world frame."""
        return np.asarray(self.earth_field, dtype=float) / MU0

    def dipoles(self, x: FloatArray) -> Dipoles:
        """Compute the dipoles of target states (n_hyp, n_t)."""
        return Dipoles(*core.row_dipoles(np.ascontiguousarray(x, dtype=float), self.n_dipoles,
                                         self.field_strength))

    def propagate(self, x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Predict states at constant velocity, or along an arc if the state has a turn rate.

        Without a turn rate, `F` (n_t, n_t) is common to all hypotheses.
        """
        if not self.turn_acceleration:
            F = np.eye(x.shape[1])
            F[:6, :6] = constant_velocity(dt)
            return x @ F.T, F
        # The turn rate does not decay backwards: without process noise, its variance would shrink.
        final_factor = math.exp(-max(dt, 0.0) / self.turn_time)
        mean_factor = (1.0 - final_factor) * self.turn_time / dt if dt > 0.0 else 1.0
        return decaying_turn(x, dt, mean_factor, final_factor)

    def turn_variance(self, speed: FloatArray) -> FloatArray:
        """Stationary variance [rad²/s²] of the turn rate at a horizontal speed."""
        min_speed = self.turn_acceleration / MAX_TURN_RATE
        return np.square(self.turn_acceleration / np.maximum(speed, min_speed))
