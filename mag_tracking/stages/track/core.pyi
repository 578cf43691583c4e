"""The filters of the tracker, compiled; `bank_filter.py` says what the arguments are."""

from collections.abc import Sequence

from mag_tracking.arrays import BoolArray, FloatArray

class _Filter:
    def advance(self, field: FloatArray, covariance: FloatArray, offset: FloatArray, dt: float,
                decay: FloatArray, variance: FloatArray, moves: bool, iterations: int,
                field_error: float, near_field_length: FloatArray, x: FloatArray, P: FloatArray,
                new_x: FloatArray, new_P: FloatArray, predicted: FloatArray,
                log_likelihood: FloatArray, nis: FloatArray) -> None: ...
    def run_along(self, *, field: FloatArray, covariance: FloatArray, offset: FloatArray,
                  dt: FloatArray, decay: FloatArray, variance: FloatArray, first_is_updated: bool,
                  strange: float, iterations: int, passes: int, step: float, field_error: float,
                  near_field_length: FloatArray, x: FloatArray, P: FloatArray, new_x: FloatArray,
                  new_P: FloatArray, paths: FloatArray, log_likelihood: FloatArray,
                  unsettled: FloatArray, covariances: FloatArray, used: BoolArray) -> None: ...

class RowVehicleFilter(_Filter):
    def __init__(self, positions: FloatArray, R_sw: FloatArray, n_angles: int, n_errors: int,
                 n_states: int, n_dipoles: int, density: Sequence[float],
                 induction: Sequence[float], moment_drift: float, difference_drift: float,
                 turn_acceleration: float, turn_time: float, fastest_turn: float) -> None: ...

class MagnetFilter(_Filter):
    def __init__(self, positions: FloatArray, R_sw: FloatArray, n_angles: int, n_errors: int,
                 density: Sequence[float], angular_density: float) -> None: ...
