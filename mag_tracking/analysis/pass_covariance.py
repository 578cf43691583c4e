"""Covariance of a fitted pass, including model errors and sensor errors."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.least_squares import model_error_covariance

POINT_REACH = 2.1
"""[m] Reach of the iron of a car from a single dipole. At distance r, the model error relative to
the field is the reach over r. Four real cars at 4.5 m had normalised costs of 10, 14, 17 and 51
(T10 Table 6.1, TSP14 Table I). Their signal energy was 1200 times the noise energy at the CPA (T10
eq. (6.1)), or 87 times per value on average over the pass. Three cars left 10 to 18 % of the energy
unexplained; the fourth, with 57 %, cannot be modelled as a point."""

ROW_REACH = 0.45
"""Reach of the iron from a row, relative to the spacing of its dipoles. With three dipoles, T10
Table 6.5 and TSP14 Table II report costs of 1.3 to 1.6 for cars, and of 77 to 303 for trucks with
twenty times the energy. These costs correspond to 0.15 to 0.45."""

MIN_ROW_REACH = 0.4
"""[m] Minimum reach of the iron from a row, from the cars in T10 Table 6.5 and TSP14 Table II."""

MIDDLE_FRACTION, MIN_MIDDLE_STD, MIDDLE_ACROSS_STD = 0.15, 0.4, 0.1
"""Standard deviation of the distance from the centre of the row to the middle of the vehicle: along
the vehicle relative to the length of the row, and at least [m]; across it and vertically [m]. The
engine of a truck is at one end, the engine and the axles of a car are nearly symmetrical."""


@dataclass(frozen=True)
class SensorErrors:
    """Sensor errors that cannot be estimated from one pass."""

    rotation_std: float = float(np.deg2rad(2.0))
    """Standard deviation of the orientation about each axis [rad], for sensors without
    `orientation_std` in the network. The default is for mounting by hand with a spirit level.
    For two sensors at a distance of 0.5 m, this error is equivalent to a delay of milliseconds."""
    gain_std: float = 0.01
    """Standard deviation of the gain of each axis; 1 to 3 % according to data sheets."""


def reach(n_dipoles: int, length: float) -> float:
    """Maximum distance [m] between the iron of a vehicle and the dipoles that model it."""
    if n_dipoles == 1:
        return POINT_REACH
    return max(MIN_ROW_REACH, ROW_REACH * abs(length) / (n_dipoles - 1))


def robust_covariance(data: PassData, whitened: FloatArray, residuals: FloatArray,
                      target: FloatArray, covariance: FloatArray,
                      errors: SensorErrors) -> FloatArray:
    """Covariance (n_x, n_x) due to noise (`covariance`), model error and sensor errors.

    `whitened` (n, 3, n_x) are whitened derivatives of the field, `residuals` (n, 3) are whitened,
    and `target` (n, 3) [T, sensor frame] is the field of the target.
    """
    model_error = model_error_covariance(*_split_by_sensor(data, whitened, residuals), covariance)
    robust: FloatArray = covariance + model_error + _sensor_error_covariance(
        data, whitened, target, covariance, errors)
    return robust


def shape_covariance(data: PassData, whitened: FloatArray, covariance: FloatArray,
                     position_index: int, n_dipoles: int, theta: FloatArray) -> FloatArray:
    """Covariance (3, 3) [m², world frame] of the middle of a vehicle about the centre of its row.

    The field of iron that extends by `reach` beyond the dipoles resembles that of dipoles at
    another distance; the relative difference is the square of reach over distance. Sensors on one
    side of a road measure a wrong range without a residual, whereas the errors of two sides cancel.
    The row is moreover not centred in the vehicle. `position_index` is the index of the unknown x
    in `whitened` (n, 3, n_x); y and z follow.
    """
    xyz = slice(position_index, position_index + 3)
    length = abs(float(theta[6])) if n_dipoles > 1 else 0.0
    forward = theta[3:6] / np.linalg.norm(theta[3:6])
    offset = theta[:3] + data.t[:, None] * theta[3:6] - data.positions
    # The nearest point of the row.
    along = np.clip(offset @ forward, -0.5 * length, 0.5 * length)
    offset = offset - along[:, None] * forward
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    extent = reach(n_dipoles, length)
    apparent = extent**2 * offset / np.maximum(distance, extent)**2
    field_error = np.einsum('nai,ni->na', whitened[:, :, xyz], apparent)
    shift = covariance[xyz] @ np.einsum('nax,na->x', whitened, field_error)
    along_variance = max(MIN_MIDDLE_STD, MIDDLE_FRACTION * length)**2
    total: FloatArray = np.outer(shift, shift) + MIDDLE_ACROSS_STD**2 * np.eye(3) \
        + (along_variance - MIDDLE_ACROSS_STD**2) * np.outer(forward, forward)
    return total


def _split_by_sensor(data: PassData, whitened: FloatArray, residuals: FloatArray) -> tuple[
        list[FloatArray], list[FloatArray], list[FloatArray]]:
    """Split times, derivatives and residuals by sensor."""
    rows = [data.sensor == j for j in data.sensors]
    return [data.t[r] for r in rows], [whitened[r] for r in rows], [residuals[r] for r in rows]


def _sensor_error_covariance(data: PassData, whitened: FloatArray, target: FloatArray,
                             covariance: FloatArray, errors: SensorErrors) -> FloatArray:
    """Covariance due to orientation and gain errors of the sensors."""
    total = np.zeros_like(covariance)
    R_sw = data.network.R_sw
    for j in data.sensors:
        sensor_mask = data.sensor == j
        configured_std = data.network.orientation_std[j]
        std = np.full(3, errors.rotation_std) if configured_std is None else configured_std
        rotation_covariance = R_sw[j] @ np.diag(np.square(std)) @ R_sw[j].T
        field = target[sensor_mask]
        G = np.concatenate([np.stack([np.cross(axis, field) for axis in np.eye(3)], axis=2),
                            field[:, :, None] * np.eye(3)], axis=2)
        shift = covariance @ np.einsum('nax,nab->xb', whitened[sensor_mask],
                                       data.whitening[sensor_mask] @ G)
        P = np.zeros((6, 6))
        P[:3, :3], P[3:, 3:] = rotation_covariance, errors.gain_std**2 * np.eye(3)
        total += shift @ P @ shift.T
    return total


def velocity_change(data: PassData, whitened: FloatArray, residuals: FloatArray, x_index: int,
                    velocity: FloatArray, duration_s: float) -> tuple[float, float]:
    """Relative change of the velocity during `duration_s`, and its std including model error.

    A constant horizontal acceleration is estimated by one Gauss-Newton step from the minimum; its
    derivatives are t²/2 times those of x and y. `x_index` is the index of the unknown x in
    `whitened` (n, 3, n_x); y follows.
    """
    by_acceleration = 0.5 * np.square(data.t)[:, None, None] * whitened[:, :, x_index:x_index + 2]
    extended = np.concatenate([whitened, by_acceleration], axis=2)
    flat = extended.reshape(residuals.size, -1)
    norm = np.linalg.norm(flat, axis=0)
    # A column of zeros cannot be normalised.
    norm[norm == 0.0] = 1.0
    inverse = np.linalg.pinv(flat / norm, rcond=1e-8) / norm[:, None]
    step, covariance = inverse @ residuals.ravel(), inverse @ inverse.T
    new_residuals = (residuals.ravel() - flat @ step).reshape(residuals.shape)
    robust = covariance + model_error_covariance(*_split_by_sensor(data, extended, new_residuals),
                                                 covariance)
    scale = duration_s / np.linalg.norm(velocity)
    return (float(np.linalg.norm(step[-2:]) * scale),
            float(np.sqrt(np.trace(robust[-2:, -2:])) * scale))
