"""Tracking of simulated passes, and simulated frames of a magnet."""

import dataclasses

import numpy as np

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from support.networks import line_network
from support.samples import one, simulate

NOISE = 1.2e-8


def drive(network, body, path, changes=None, duration=12.0, flaws=None, seed=0):
    """Simulate and track a pass; return (`Track` records, pipeline, true positions (n, 2) [m])."""
    samples, t, position, _ = simulate(network, body, path, 100.0, duration,
                                       np.random.default_rng(seed), flaws)
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    records = [r for s in samples for r in pipeline.feed(one(s))] + pipeline.flush()
    tracks = [r for r in records if isinstance(r, Track)]
    stamps = np.array([r.stamp_ns for r in tracks if not r.ended]) / 1e9
    truth = np.stack([np.interp(stamps, t, position[:, k]) for k in (0, 1)], axis=1)
    return tracks, pipeline, truth


def magnet_frames(n=40, dt=0.1, lost=None):
    """Simulate a magnet that circles above a board of nine sensors: (network, frames, truth).

    The truth (n, 6) is the position [m] and moment [A m²]. Sensors with indices `lost` have no
    readings.
    """
    grid = np.array([[x, y, 0.0] for x in (-0.05, 0.0, 0.05) for y in (-0.05, 0.0, 0.05)])
    network = dataclasses.replace(
        line_network(9), positions=grid, background=(np.zeros(3),) * 9,
        noise_std=(np.full(3, 1e-7),) * 9)
    rng = np.random.default_rng(4)
    frames, truth = [], []
    for k in range(n):
        a = 0.08 * k
        r = np.array([0.03 * np.cos(a), 0.03 * np.sin(a), 0.06])
        m = 0.3 * np.array([np.sin(0.5 * a), 0.0, np.cos(0.5 * a)])
        B = np.einsum('jik,jk->ji', network.R_sw, dipole_field(grid - r, m))
        y = B + 1e-7 * rng.standard_normal(B.shape)
        if lost is not None:
            y[lost] = np.nan
        frames.append(FieldFrame(int(k * dt * 1e9), y, np.repeat(1e-14 * np.eye(3)[None], 9, 0),
                                 np.ones(9, dtype=int), np.zeros(9), True, 1e6, 27))
        truth.append(np.r_[r, m])
    return network, frames, np.array(truth)
