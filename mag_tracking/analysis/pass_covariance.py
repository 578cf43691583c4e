"""Covariance of a fitted pass that includes model errors and sensor errors."""

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
    `orientation_std` in the network: mounted by hand, with a spirit level. Between two sensors half
    a metre apart this is a delay of milliseconds."""
    gain_std: float = 0.01
    """Standard deviation of the gain of each axis; data sheets state 1 to 3 %."""


def robust_covariance(data: PassData, whitened: FloatArray, residuals: FloatArray,
                      target: FloatArray, covariance: FloatArray,
                      errors: SensorErrors) -> FloatArray:
    """Covariance due to noise, model error and sensor errors.

    Parameters
    ----------
    data : PassData
    whitened : (n, 3, n_x) array
        Whitened derivatives.
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
    of_model = model_error_covariance(*_by_sensor(data, whitened, residuals), covariance)
    robust: FloatArray = (covariance + of_model
                          + _of_sensors(data, whitened, target, covariance, errors))
    return robust


def _by_sensor(data: PassData, whitened: FloatArray, residuals: FloatArray) -> tuple[
        list[FloatArray], list[FloatArray], list[FloatArray]]:
    """Times, derivatives and residuals of each sensor."""
    rows = [data.sensor == j for j in data.sensors]
    return [data.t[r] for r in rows], [whitened[r] for r in rows], [residuals[r] for r in rows]


def _of_sensors(data: PassData, whitened: FloatArray, target: FloatArray, covariance: FloatArray,
                errors: SensorErrors) -> FloatArray:
    """Covariance due to orientation and gain errors, which shift the minimum with the fields."""
    total = np.zeros_like(covariance)
    R_sw = data.network.R_sw
    for j in data.sensors:
        mine = data.sensor == j
        known = data.network.orientation_std[j]
        world = np.full(3, errors.rotation_std) if known is None else known
        turns = R_sw[j] @ np.diag(np.square(world)) @ R_sw[j].T
        field = target[mine]
        G = np.concatenate([np.stack([np.cross(axis, field) for axis in np.eye(3)], axis=2),
                            field[:, :, None] * np.eye(3)], axis=2)
        moved = covariance @ np.einsum('nax,nab->xb', whitened[mine], data.whitening[mine] @ G)
        spread = np.zeros((6, 6))
        spread[:3, :3], spread[3:, 3:] = turns, errors.gain_std**2 * np.eye(3)
        total += moved @ spread @ moved.T
    return total


def velocity_change(data: PassData, whitened: FloatArray, residuals: FloatArray, first: int,
                    velocity: FloatArray, duration_s: float) -> tuple[float, float]:
    """Relative change of the velocity while the target is observed.

    One Gauss-Newton step from the minimum with a constant horizontal acceleration as an additional
    unknown. The acceleration moves the target by t²/2 where a shift of its start moves it by 1, so
    its derivatives follow from those by x and y.

    Parameters
    ----------
    data : PassData
    whitened : (n, 3, n_x) array
        Whitened derivatives.
    residuals : (n, 3) array
        Whitened residuals.
    first : int
        Index of the unknown x of the target; y follows.
    velocity : (3,) array, m/s
    duration_s : float, s
        Duration of the observation.

    Returns
    -------
    share : float
        Change relative to the speed.
    std : float
        Standard deviation of the share, including model error.
    """
    moved = 0.5 * np.square(data.t)[:, None, None] * whitened[:, :, first:first + 2]
    wider = np.concatenate([whitened, moved], axis=2)
    flat = wider.reshape(residuals.size, -1)
    size = np.linalg.norm(flat, axis=0)
    # A zero column has no scale.
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(flat / size, rcond=1e-8) / size[:, None]
    step, covariance = inverse @ residuals.ravel(), inverse @ inverse.T
    rest = (residuals.ravel() - flat @ step).reshape(residuals.shape)
    robust = covariance + model_error_covariance(*_by_sensor(data, wider, rest), covariance)
    scale = duration_s / np.linalg.norm(velocity)
    return (float(np.linalg.norm(step[-2:]) * scale),
            float(np.sqrt(np.trace(robust[-2:, -2:])) * scale))
