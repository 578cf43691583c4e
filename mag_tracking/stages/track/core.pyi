"""Compiled filters and pass fit of the tracker.

The arguments are described in `bank_filter.py` and `pass_samples.py`.
"""

from collections.abc import Sequence

from mag_tracking.arrays import BoolArray, FloatArray, IntArray

MAX_TARGETS: int
"""Maximum number of vehicles that share a state."""

class _Filter:
    def advance(self, field: FloatArray, covariance: FloatArray, offset: FloatArray, dt: float,
                decay: FloatArray, variance: FloatArray, moves: bool, iterations: int,
                field_error: float, near_field_length: FloatArray, x: FloatArray, P: FloatArray,
                new_x: FloatArray, new_P: FloatArray, predicted: FloatArray,
                log_likelihood: FloatArray, nis: FloatArray) -> None: ...
    def run_along(self, *, field: FloatArray, covariance: FloatArray, offset: FloatArray,
                  dt: FloatArray, decay: FloatArray, variance: FloatArray, first_is_updated: bool,
                  max_nis: float, iterations: int, passes: int, step: float, field_error: float,
                  near_field_length: FloatArray, x: FloatArray, P: FloatArray, new_x: FloatArray,
                  new_P: FloatArray, paths: FloatArray, log_likelihood: FloatArray,
                  max_shift: FloatArray, covariances: FloatArray, used: BoolArray) -> None: ...

class RowVehicleFilter(_Filter):
    def __init__(self, positions: FloatArray, R_sw: FloatArray, n_angles: int, n_errors: int,
                 n_states: int, n_dipoles: int, density: Sequence[float],
                 field_strength: Sequence[float], moment_drift: float, difference_drift: float,
                 turn_acceleration: float, turn_time: float, max_turn_rate: float) -> None: ...

class VehiclesFilter(_Filter):
    """Filter of `count` vehicles whose fields add up."""

    def __init__(self, positions: FloatArray, R_sw: FloatArray, n_angles: int, n_errors: int,
                 count: int, n_states: int, n_dipoles: int, density: Sequence[float],
                 field_strength: Sequence[float], moment_drift: float, difference_drift: float,
                 turn_acceleration: float, turn_time: float, max_turn_rate: float) -> None: ...

class MagnetFilter(_Filter):
    def __init__(self, positions: FloatArray, R_sw: FloatArray, n_angles: int, n_errors: int,
                 density: Sequence[float], angular_density: float) -> None: ...

def fit_steady_pass(*, theta: FloatArray, cost: FloatArray, covariance: FloatArray, free: IntArray,
                    fixed: FloatArray, offsets: FloatArray, combinations: FloatArray, t: FloatArray,
                    positions: FloatArray, M: FloatArray, clock: IntArray, y: FloatArray,
                    nuisance: FloatArray, n_steps: int, tolerance: float, max_damping: float,
                    full_rank: float, linear_rank: float, rank: float) -> None:
    """Fit a `SteadyPass` from each start by the method of `least_squares.refine`.

    The starts `theta` (n, n_free) are replaced by the minima, with their `cost` (n,) and
    `covariance` (n, n_free, n_free). The columns of `nuisance` (n_y, q) are orthonormal, and have
    been projected out of `y`.
    """
