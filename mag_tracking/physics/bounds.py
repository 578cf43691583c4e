"""Bounds of quantities that no target and no sensor exceeds.

A filter or a fit that leaves these bounds has followed wrong readings, such as timestamps in
another unit. Its numbers are not reported; the reason is.
"""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray

MAX_SPEED = 200.0
"""[m/s] The fastest train has reached 167 m/s."""
MAX_MOMENT = 1e5
"""[A m^2] A car has 300 to 600, a truck 1800, a wagon of a train 5000."""
MAX_MOUNTING = 0.5 * np.pi
"""[rad] The mounting angles of a track are small rotations, which are linearised."""
TOO_FAST = f'a speed above {MAX_SPEED:g} m/s is impossible'
TOO_STRONG = f'a moment above {MAX_MOMENT:g} A m^2 is impossible'
TOO_ROTATED = f'mounting angles above {np.degrees(MAX_MOUNTING):.0f} degrees are impossible'
REASONS = (TOO_FAST, TOO_STRONG, TOO_ROTATED)
"""Reasons why a result is not reported."""
ADVICE = 'check the unit of the readings, their timestamps, and the positions in the network file'
"""Remedy for an impossible result."""


def are_possible(velocities: FloatArray, moments: FloatArray) -> BoolArray:
    """Whether velocities (..., 3) [m/s] and moments (..., 3) [A m²] are within the bounds."""
    # A comparison with NaN is false.
    are_within: BoolArray = (np.linalg.norm(velocities, axis=-1) <= MAX_SPEED) \
        & (np.linalg.norm(moments, axis=-1) <= MAX_MOMENT)
    return are_within


def impossible_reason(velocity: FloatArray, moment: FloatArray,
                      mounting: FloatArray | None = None) -> str:
    """Element of `REASONS` why the state of a target is impossible, or ''; `mounting`
    (n_sensors, 3) [rad] is NaN for an unused sensor."""
    if not np.linalg.norm(velocity) <= MAX_SPEED:
        return TOO_FAST
    if not np.linalg.norm(moment) <= MAX_MOMENT:
        return TOO_STRONG
    if mounting is not None and np.nanmax(np.abs(mounting), initial=0.0) > MAX_MOUNTING:
        return TOO_ROTATED
    return ''
