"""Passes of a car past two coarse sensors 0.5 m apart, and the speeds estimated from them.

The values are those of real installations beside a lane: 200 Hz, a resolution of 1 µT, a bus error
in one of a thousand readings, the side of the car at 0.8 m, and 5 to 20 m/s.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from mag_tracking.analysis.correlated_motion import CorrelatedMotion, correlated_motion
from mag_tracking.analysis.fitted_pass import choose_order
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.simulation.scenario import Path
from support import spoiler
from support.box_vehicles import UNCALIBRATED, box_car
from support.live_runs import passes_of
from support.passes import network_of
from support.samples import scenario

PAIR = network_of([[-0.25, 0.0, 0.0], [0.25, 0.0, 0.0]])
STEP, RATE, SIDE = 1e-6, 200.0, 0.8


def readings_of(seed):
    """Simulate a random pass; return (`Readings`, velocity along x [m/s], time of the CPA [s])."""
    rng = np.random.default_rng([seed, 77])
    body = box_car(rng)
    half = 0.5 * body.sides[0, 1] / 0.9
    speed, heading = rng.uniform(5.0, 20.0), np.pi * rng.integers(2)
    lateral = rng.choice([-1.0, 1.0]) * (SIDE + half)
    lead = 8.0 * speed + 10.0
    path = Path(np.array([-lead * np.cos(heading), lateral]), heading, speed)
    readings, *_ = scenario.simulate(PAIR, body, path, RATE, 2.0 * lead / speed, rng, UNCALIBRATED)
    faulty = spoiler.apply(readings, spoiler.steps(STEP), spoiler.glitches(0.001, 1e-4, seed))
    return faulty, speed * np.cos(heading), lead / speed


@dataclass(frozen=True)
class VelocityEstimates:
    """Estimates for a pass. A pair is (velocity along x, standard deviation) [m/s]."""

    truth: float
    fit: tuple[float, float] | None
    track: tuple[float, float] | None
    smoothed: tuple[float, float] | None
    delay: CorrelatedMotion
    ambiguous: bool
    """Whether the track is ambiguous at the CPA."""


def _velocity_along_x(pose):
    return float(pose.velocity[0]), float(np.sqrt(pose.covariance[3, 3]))


@cache
def pass_of(seed):
    """Collect the `PassData` of a random pass."""
    passes = passes_of(PAIR, [readings_of(seed)[0]])
    return max((data for data, _ in passes), key=lambda data: data.n_values)


@cache
def estimates_of(seed):
    """Estimate the velocity of a random pass by all methods; return `VelocityEstimates`."""
    readings, truth, closest_s = readings_of(seed)
    pipeline = Pipeline(PAIR, settings_for('vehicle'))
    records = pipeline.feed(readings) + pipeline.flush()
    nearest = {}
    for kind in (Track, SmoothedPose):
        poses = [r for r in records if isinstance(r, kind) and not getattr(r, 'ended', False)]
        nearest[kind] = min(poses, key=lambda r: abs(r.stamp_ns / 1e9 - closest_s), default=None)
    track, smoothed = nearest[Track], nearest[SmoothedPose]
    data = pass_of(seed)
    fits = [fit_pass(data, n) for n in (1, 2, 3)]
    best = choose_order(fits)
    return VelocityEstimates(
        truth, None if best is None else (float(best.velocity[0]), float(
            np.sqrt(best.robust_covariance[3, 3]))),
        None if track is None else _velocity_along_x(track),
        None if smoothed is None else _velocity_along_x(smoothed), correlated_motion(data),
        track is not None and track.ambiguous)
