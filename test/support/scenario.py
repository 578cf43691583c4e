"""Simulated readings of all sensors with ground truth, and targets that match the tracker's model.

A body has a method `field(earth_field, position, heading, points)`: the field (n, n_sensors, 3) [T]
at `points` (n_sensors, 3) [m] of the body at horizontal positions (n, 2) [m] with headings (n,)
[rad], all in the world frame. A path has a method `at(t)`: the positions and headings at times (n,)
[s]. The bodies and paths of `mag_tracking.simulation.scenario` are examples.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.records import Readings
from mag_tracking.simulation.scenario import MagneticBody


def point_body(hard_iron, soft_iron, height):
    """Create a point target that matches the model of the tracker.

    `hard_iron` (3,) [A m²] is the moment m0 in the body frame, `soft_iron` [m³] the value D of all
    axes, `height` [m] that above the ground.
    """
    return MagneticBody(np.array([[0.0, 0.0, height]]), np.array([hard_iron], dtype=float),
                        soft_iron * np.eye(3)[None])


@dataclass(frozen=True)
class SensorErrorModel:
    """Standard deviations of random sensor errors; zero disables an error."""

    noise_std: float = 1.2e-8
    """White noise, T."""
    bias_std: float = 0.0
    """Constant bias, T."""
    drift_std: float = 0.0
    """Constant drift rate, T/s."""
    tilt_std: float = 0.0
    """Mounting error about each axis, relative to the network file, rad."""
    clock_std: float = 0.0
    """Constant clock offset, s; 0 for the first sensor."""
    gain_std: float = 0.0
    """Relative gain error of each axis."""


def simulate(network, body, path, rate, duration, rng, sensor_errors=None, start_s=0.0):
    """Simulate the raw readings of all sensors for one body, with ground truth.

    The samples at `rate` [Hz] begin at the timestamp `start_s` [s]. By default, the only sensor
    error is white noise. Return the readings in chronological order, the time (n,) [s] of each
    sample since the start, and the true position (n, 2) [m] and heading (n,) [rad] at these times.
    Raises ValueError if the network has no Earth's field.
    """
    errors, earth_field = sensor_errors or SensorErrorModel(), network.earth_field
    if earth_field is None:
        raise ValueError('the simulation requires a network with an earth field; set earth_field')
    t = np.arange(0.0, duration, 1.0 / rate, dtype=float)
    fields = []
    for j in range(len(network)):
        offset = errors.clock_std * rng.standard_normal() if j else 0.0
        position, heading = path.at(t + offset)
        B = earth_field + body.field(earth_field, position, heading,
                                     network.positions[j:j + 1])[:, 0]
        a, b, c = errors.tilt_std * rng.standard_normal(3)
        tilt = np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]])
        y = B @ network.R_ws[j] @ tilt
        if errors.gain_std:
            y *= 1.0 + errors.gain_std * rng.standard_normal(3)
        y += errors.bias_std * rng.standard_normal(3)
        y += errors.drift_std * rng.standard_normal(3) * t[:, None]
        y += errors.noise_std * rng.standard_normal(y.shape)
        fields.append(y)
    n = len(network)
    stamps = np.array([int(round((start_s + s) * 1e9)) for s in t], dtype=np.int64)
    readings = Readings(network.names, np.tile(np.arange(n), len(t)), np.repeat(stamps, n),
                        np.stack(fields, axis=1).reshape(-1, 3))
    return readings, t, *path.at(t)
