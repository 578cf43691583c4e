"""Covariance of a fitted pass, including model errors and sensor errors."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.least_squares import model_error_covariance


@dataclass(frozen=True)
class SensorErrors:
    """Sensor errors that cannot be estimated from one pass."""

    rotation_std: float = float(np.deg2rad(2.0))
    """Standard deviation of the orientation about each axis [rad], for sensors without
    `orientation_std` in the network. The default is for mounting by hand with a spirit level.
    For two sensors at a distance of 0.5 m, this error is equivalent to a delay of milliseconds."""
    gain_std: float = 0.01
    """Standard deviation of the gain of each axis; 1 to 3 % according to data sheets."""


def robust_covariance(data: PassData, whitened: FloatArray, residuals: FloatArray,
                      target: FloatArray, covariance: FloatArray,
                      errors: SensorErrors) -> FloatArray:
    """Compute the covariance due to noise, model error and sensor errors.

    Parameters
    ----------
    data : PassData
    whitened : (n, 3, n_x) array
        Whitened derivatives of the field with respect to the unknowns.
    residuals : (n, 3) array
        Whitened residuals.
    target : (n, 3) array, T, sensor frame
        Field of the target.
    covariance : (n_x, n_x) array
        Covariance due to noise alone.
    errors : SensorErrors

    Returns
    -------
    (n_x, n_x) array
    """
    model_error = model_error_covariance(*_split_by_sensor(data, whitened, residuals), covariance)
    robust: FloatArray = covariance + model_error + _sensor_error_covariance(
        data, whitened, target, covariance, errors)
    return robust


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
    """Estimate the relative change of the velocity while the target is observed.

    A constant horizontal acceleration is added to the unknowns and estimated by one Gauss-Newton
    step from the minimum. The derivatives with respect to the acceleration are t²/2 times the
    derivatives with respect to x and y.

    Parameters
    ----------
    data : PassData
    whitened : (n, 3, n_x) array
        Whitened derivatives of the field with respect to the unknowns.
    residuals : (n, 3) array
        Whitened residuals.
    x_index : int
        Index of the unknown x of the target; the next unknown is y.
    velocity : (3,) array, m/s
    duration_s : float, s
        Duration of the observation.

    Returns
    -------
    change : float
        Change relative to the speed.
    std : float
        Standard deviation of the change, including model error.
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
