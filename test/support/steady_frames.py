"""Frames of a row of dipoles on a steady path."""

import numpy as np

from mag_tracking.physics.passes import N_PATH, SteadyPass
from mag_tracking.records import FieldFrame
from mag_tracking.units import NS
from support.passes import NOISE, network_of

ROAD = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0]])
FOUR = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0], [9.0, -4.5, 0.0], [9.0, 4.5, 0.0]])
STRAIGHT = np.array([0.0, 1.0, 0.5, 20.0, 0.05, 0.0, 3.0, 0.0, 0.0, 0.0])
TURNS = np.array([0.0, 1.0, 0.5, 8.0, 0.0, 0.0, 3.0, 1.0, 0.7, 0.0])
MOMENTS = np.array([[150.0, 40.0, -120.0], [90.0, -60.0, -160.0], [110.0, 70.0, -90.0]])


def steady_frames(rng, network=ROAD, path=STRAIGHT, clocks=(), change=None, period_s=0.08,
                  until_s=1.2):
    """Simulate the frames from 1.6 s before to `until_s` after the CPA."""
    # `clocks` [s] are the clock offsets of all sensors except the first. `change` is a function
    # that modifies the fields (n_frames, n_sensors, 3).
    t = np.arange(-1.6, until_s, period_s)
    n = len(network)
    theta = np.concatenate([path, np.zeros(n - 1)])
    theta[N_PATH:N_PATH + len(clocks)] = clocks
    times, sensor = np.repeat(t, n), np.tile(np.arange(n), len(t))
    model = SteadyPass(times, network.positions[sensor], np.tile(np.eye(3), (len(times), 1, 1)),
                       sensor - 1, np.arange(len(theta)), theta, len(MOMENTS))
    # The linear parameters are combinations of the moments.
    fractions = np.linspace(-0.5, 0.5, len(MOMENTS))
    combinations = np.kron(np.linalg.qr(np.vander(fractions, increasing=True))[0], np.eye(3))
    B = (model.basis(theta[None])[0] @ combinations.T @ MOMENTS.ravel()).reshape(len(t), n, 3)
    B = B + NOISE * rng.standard_normal(B.shape)
    B = B if change is None else change(B)
    C = np.tile(NOISE**2 * np.eye(3), (n, 1, 1))
    return [FieldFrame(round(at * NS), field,
                       np.where(np.isnan(field)[:, :, None] | np.isnan(field)[:, None], np.nan, C),
                       np.full(n, 8), np.zeros(n)) for at, field in zip(t, B, strict=True)]


def state_at(t, path=STRAIGHT):
    """Position [m] and velocity [m/s] at time `t` [s] on a straight path, (6,)."""
    velocity = path[3] * np.array([np.cos(path[4]), np.sin(path[4]), 0.0])
    return np.append(path[:3] + t * velocity, velocity)
