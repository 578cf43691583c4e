"""How far a fitted pass may be off: by what its model leaves out, and by its sensors' errors."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.least_squares import model_error_covariance


@dataclass(frozen=True)
class SensorErrors:
    """Errors of the sensors that no fit finds from one pass."""

    turn_std: float = float(np.deg2rad(2.0))
    """[rad] about each axis, of a sensor whose `orientation_std` the network does not say: set up
    by hand, with a level. Between two sensors that are half a metre apart that is a delay of
    milliseconds."""
    gain_std: float = 0.01
    """Deviation of the gain of each axis; data sheets say 1 to 3 %."""


def robust_covariance(data: PassData, whitened: FloatArray, left: FloatArray, target: FloatArray,
                      covariance: FloatArray, errors: SensorErrors) -> FloatArray:
    """A covariance by noise, what the model leaves out and the sensors' errors.

    Parameters
    ----------
    data : PassData
    whitened, left : (n, 3, n_x), (n, 3)
        Derivatives and residuals.
    target : (n, 3) [T]
        The target's field, sensor frame.
    covariance : (n_x, n_x)
        By noise alone.
    errors : SensorErrors

    Returns
    -------
    (n_x, n_x)
    """
    honest: FloatArray = (covariance + model_error_covariance(*_by_sensor(data, whitened, left),
                                                           covariance)
                          + _of_sensors(data, whitened, target, covariance, errors))
    return honest


def _by_sensor(data: PassData, whitened: FloatArray, left: FloatArray) -> tuple[
        list[FloatArray], list[FloatArray], list[FloatArray]]:
    """Times, derivatives and residuals of each sensor."""
    rows = [data.sensor == j for j in data.sensors]
    return [data.t[r] for r in rows], [whitened[r] for r in rows], [left[r] for r in rows]


def _of_sensors(data: PassData, whitened: FloatArray, target: FloatArray, covariance: FloatArray,
                errors: SensorErrors) -> FloatArray:
    """The covariance that turned sensors and gains add: they move the minimum with the fields."""
    total = np.zeros_like(covariance)
    R_sw = data.network.R_sw
    for j in data.sensors:
        mine = data.sensor == j
        known = data.network.orientation_std[j]
        world = np.full(3, errors.turn_std) if known is None else known
        turns = R_sw[j] @ np.diag(np.square(world)) @ R_sw[j].T
        field = target[mine]
        G = np.concatenate([np.stack([np.cross(axis, field) for axis in np.eye(3)], axis=2),
                            field[:, :, None] * np.eye(3)], axis=2)
        moved = covariance @ np.einsum('nax,nab->xb', whitened[mine], data.whitening[mine] @ G)
        spread = np.zeros((6, 6))
        spread[:3, :3], spread[3:, 3:] = turns, errors.gain_std**2 * np.eye(3)
        total += moved @ spread @ moved.T
    return total


def velocity_change(data: PassData, whitened: FloatArray, left: FloatArray, first: int,
                    velocity: FloatArray, seen_s: float) -> tuple[float, float]:
    """Share of itself by which the velocity would like to change while the target is seen.

    One step of Gauss and Newton from the minimum, with a constant horizontal acceleration more
    among the unknowns: it moves the target by t^2/2, as its start moves it by 1, whose x and y are
    the unknowns `first` and the next one. Returns the share and its deviation, by noise and by what
    is left over with the acceleration.
    """
    moved = 0.5 * np.square(data.t)[:, None, None] * whitened[:, :, first:first + 2]
    wider = np.concatenate([whitened, moved], axis=2)
    flat = wider.reshape(left.size, -1)
    size = np.linalg.norm(flat, axis=0)
    # What nothing depends on has no derivative.
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(flat / size, rcond=1e-8) / size[:, None]
    step, covariance = inverse @ left.ravel(), inverse @ inverse.T
    rest = (left.ravel() - flat @ step).reshape(left.shape)
    honest = covariance + model_error_covariance(*_by_sensor(data, wider, rest), covariance)
    scale = seen_s / np.linalg.norm(velocity)
    return (float(np.linalg.norm(step[-2:]) * scale),
            float(np.sqrt(np.trace(honest[-2:, -2:])) * scale))
