"""Simulated worlds with bodies and disturbances around a network, and the true trajectories."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.network import SensorNetwork
from mag_tracking.records import Readings
from mag_tracking.simulation.scenario import Path
from support.box_vehicles import UNCALIBRATED, magnetised
from support.samples import scenario
from support.scenario import SensorErrorModel

GRID_S = 0.01
"""[s] Step of the integration of the speed in a `Ride`."""


@dataclass(frozen=True)
class Ride:
    """Course along a `Path` at any speed, with stops and reversals."""

    path: Path
    times: tuple
    """Times of the given speeds, (k,) s."""
    speeds: tuple
    """Speeds at `times`, (k,) m/s, interpolated linearly; negative in reverse."""

    def at(self, t):
        """Position and heading at times `t`; a path of `support.scenario`."""
        t = np.asarray(t, dtype=float)
        grid = np.arange(0.0, max(self.times[-1], t.max()) + 2 * GRID_S, GRID_S)
        speed = np.interp(grid, self.times, self.speeds)
        distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * GRID_S)])
        # Because of clock offsets, `t` may be negative.
        before = np.minimum(t, 0.0) * self.speeds[0]
        return self.path.at((np.interp(t, grid, distance) + before) / self.path.speed)


@dataclass(frozen=True)
class Convoy:
    """Bodies at fixed distances from each other, such as a car with a trailer."""

    bodies: tuple
    behind: tuple
    """[m] Distance of the centre of each body behind the centre of the convoy."""

    def field(self, earth_field, position, heading, points):
        """Field of all bodies at `points`; a body of `support.scenario`."""
        forward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        return sum(body.field(earth_field, position - back * forward, heading, points)
                   for body, back in zip(self.bodies, self.behind, strict=True))


@dataclass(frozen=True)
class World:
    """Readings of a network, and the true positions of all bodies."""

    network: SensorNetwork
    readings: Readings
    t: np.ndarray
    """Times of the true positions, (n,) s."""
    positions: np.ndarray
    """True positions of the bodies, (n_bodies, n, 2) m."""


def box_two_wheeler(rng, length, moment, iron=1.0):
    """Motorcycle, bicycle or trolley of boxes: a frame (weight 1), an engine (weight `iron`), two
    wheels."""
    parts = [((0.0, 0.0, 0.5), (0.5 * length, 0.06, 0.5), 1.0),
             ((0.05 * length, 0.0, 0.4), (0.35, 0.3, 0.3), iron)]
    parts += [((0.35 * end * length, 0.0, 0.3), (0.05, 0.15, 0.5), 0.4) for end in (-1, 1)]
    return magnetised(rng, parts, length, moment)


def world(network, movers, duration, rng, flaws=None, rate=100.0, ambient=None):
    """Simulate movers [(body, course)] for `duration` [s] with sensor errors; return a `World`."""
    # `ambient` is a function from times (n,) [s] to fields (n, n_sensors, 3) [T], world frame.
    flaws = flaws or SensorErrorModel()
    t = np.arange(0.0, duration, 1.0 / rate)
    parts = []
    for body, course in movers:
        # Each body is simulated separately with perfect sensors; the fields are added.
        readings, *_ = scenario.simulate(network, body, course, rate, duration, rng,
                                         SensorErrorModel(noise_std=0.0))
        parts.append(readings.field.reshape(len(t), len(network), 3) - _earth(network))
    B = sum(parts, np.zeros((len(t), len(network), 3))) + _earth(network)
    if ambient is not None:
        B = B + np.einsum('nji,jik->njk', ambient(t), network.R_ws)
    B = _flawed(B, flaws, t, rng)
    stamps = np.repeat(np.round(t * 1e9).astype(np.int64), len(network))
    readings = Readings(network.names, np.tile(np.arange(len(network)), len(t)), stamps,
                        B.reshape(-1, 3))
    positions = np.array([course.at(t)[0] for _, course in movers]).reshape(-1, len(t), 2)
    return World(network, readings, t, positions)


def _earth(network):
    """Earth field at each sensor, (n_sensors, 3) T, sensor frames."""
    return np.einsum('jik,i->jk', network.R_ws, network.earth_field)


def _flawed(B, flaws, t, rng):
    """Add the sensor errors `flaws` to fields (n, n_sensors, 3) [T]."""
    out = np.empty_like(B)
    for j in range(B.shape[1]):
        a, b, c = flaws.tilt_std * rng.standard_normal(3)
        tilt = np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]])
        out[:, j] = B[:, j] @ tilt * (1.0 + flaws.gain_std * rng.standard_normal(3))
        out[:, j] += flaws.bias_std * rng.standard_normal(3)
        out[:, j] += flaws.drift_std * rng.standard_normal(3) * t[:, None]
    return out + flaws.noise_std * rng.standard_normal(out.shape)


FLAWS = {'clouds': SensorErrorModel(), 'boxes': UNCALIBRATED}
"""{simulator: `SensorErrorModel` of its sensors}."""
