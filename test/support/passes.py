"""Random passes for the tests and the benchmark of the batch fit."""

from dataclasses import replace

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.passes import RowPass

NOISE = 1.2e-8
EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])


def network_of(positions):
    """Network of upright sensors at `positions`."""
    positions = np.asarray(positions, dtype=float)
    names = tuple(f'mag_{i + 1}' for i in range(len(positions)))
    return SensorNetwork(names, positions, np.tile(np.eye(3), (len(names), 1, 1)),
                         tuple(f'/{n}/imu/mag' for n in names), earth_field=EARTH)


ROAD = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0]])


def random_moments(rng, n_dipoles):
    """Random moments (d, 3) [A m²] of a row of dipoles."""
    total = rng.standard_normal(3)
    total *= rng.uniform(200.0, 600.0) / np.linalg.norm(total)
    moments = np.tile(total / n_dipoles, (n_dipoles, 1))
    return moments if n_dipoles == 1 else moments + 60.0 * rng.standard_normal((n_dipoles, 3))


def random_path(rng, n_dipoles, road):
    """Random path and moments (d, 3) [A m²], along the road if `road`, otherwise with any heading.

    The path (6,) consists of position and velocity; (7,) also includes the length of several
    dipoles.
    """
    heading = rng.uniform(0.0, 2.0 * np.pi)
    if road:
        heading = np.pi * rng.integers(2) + 0.03 * rng.standard_normal()
    along, across = np.array([[1, 0], [0, 1]]) @ [[np.cos(heading), np.sin(heading)],
                                                  [-np.sin(heading), np.cos(heading)]]
    offset = rng.uniform(-2.5, 2.5) if road else rng.uniform(-6.0, 6.0)
    position = np.append(offset * across + rng.uniform(-2.0, 2.0) * along, rng.uniform(0.3, 1.0))
    velocity = np.append(rng.uniform(4.0, 20.0) * along, 0.05 * rng.standard_normal())
    moments = random_moments(rng, n_dipoles)
    length = [rng.uniform(2.0, 5.0)] if n_dipoles > 1 else []
    return np.concatenate([position, velocity, length]), moments


def measured(network, path, moments, rng, rate=100.0, seconds=4.0, noise=NOISE):
    """Simulate the `PassData` of a row of dipoles; the middle of the pass is at time zero."""
    n = int(seconds * rate)
    t = np.tile((np.arange(n) - n / 2) / rate, len(network))
    sensor = np.repeat(np.arange(len(network)), n)
    model = RowPass(t, network.positions[sensor], network.R_sw[sensor], len(moments))
    B = (model.basis(path[None])[0] @ (model.combinations.T @ moments.ravel())).reshape(-1, 3)
    return PassData(network, 0, t, sensor, B + noise * rng.standard_normal(B.shape),
                    np.tile(noise**2 * np.eye(3), (len(t), 1, 1)))


def superposed(first, second):
    """`PassData` of two targets at once: the sum of their fields, with the noise of the first."""
    return replace(first, field=first.field + second.field)


def unknowns_at(path, moments, seconds):
    """Move the reference time of `path` later by `seconds`; return the unknowns of a fit."""
    moved = path.copy()
    moved[:3] += seconds * path[3:6]
    return np.concatenate([moved, moments.ravel()])
