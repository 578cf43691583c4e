"""Simulation of the traffic in PHD15 Paper B: 511 vehicles between two sensors with two axes.

The lanes, counts per direction, distances and speed are taken from the paper. The vehicles come
from either simulator, the sensors have errors, and some vehicles meet or follow closely.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.inference.driving_direction import (
    FieldRotation,
    fused_log_odds,
    rotation_of_pass,
)
from support.direction_likelihood import (
    LaneHypothesis,
    direction_likelihood_ratio,
)
from support.passes import EARTH
from support.situation_worlds import car, truck

SENSORS = np.array([[0.0, -5.0, 0.0], [0.0, 5.0, 0.0]])
LANE_M = 1.5
"""[m] Distance of each lane from the x axis; each is 3.5 m from one sensor and 6.5 m from the
other. The northbound lane is at negative y and leads along x."""
N_NORTH, N_SOUTH = 291, 220
SPEED, SPEED_STD = 25.0, 2.5
MINUTES = 120.0
RATE = 100.0
WINDOW_S, PAD_S = 0.7, 0.4
"""[s] Length of the window and of its margins. The paper uses 1.5 s, in which other vehicles
interfere more."""
SATURATION = 200e-6
NOISE = 3e-8
"""[T] Noise on each axis."""
OFFSET_STD = 5e-9
"""[T] Standard deviation of the background error."""
TRUCKS = 0.1
MIN_HEADWAY_S = 1.0
"""[s] Minimum headway in one lane."""


@dataclass(frozen=True)
class Passing:
    """Passing vehicle, with the measurements of both sensors and the truth."""

    t: np.ndarray
    """Time since the CPA, (n,) s."""
    field: np.ndarray
    """Field at each sensor, (2, n, 2) T, world axes."""
    is_north: bool
    headway: float
    """Time to the closest other vehicle, s."""

    @property
    def near(self):
        """Index of the sensor beside the lane of the vehicle."""
        return 0 if self.is_north else 1

    def rotations(self):
        """`FieldRotation` of each sensor, with log odds 0 if the direction is unobservable."""
        pad = int(PAD_S * RATE)
        return [rotation_of_pass(field, NOISE, pad) or FieldRotation(0.0, 1.0)
                for field in self.field]

    def likelihood_ratio_of_north(self):
        """Log-likelihood ratios of northbound to southbound: ([ratio of each sensor], sum)."""
        near, far = 5.0 - LANE_M, 5.0 + LANE_M
        one = direction_likelihood_ratio(self.t, self.field[0], NOISE,
                                         LaneHypothesis(SPEED, near), LaneHypothesis(-SPEED, far))
        # The second sensor faces -y, so its axes are rotated.
        other = direction_likelihood_ratio(self.t, -self.field[1], NOISE,
                                           LaneHypothesis(SPEED, near),
                                           LaneHypothesis(-SPEED, far))
        return [one, -other], one - other

    def log_odds_of_north(self):
        """Log odds of the northbound direction: ([log odds of each sensor], fused log odds)."""
        # Seen from the first sensor, a northbound vehicle moves from left to right.
        one, other = (r.log_odds for r in self.rotations())
        return [one, -other], fused_log_odds([one, other], [True, False])


def arrivals(rng):
    """Random arrivals in chronological order: [(time [s], whether northbound, speed [m/s])]."""
    out = []
    for n, is_north in ((N_NORTH, True), (N_SOUTH, False)):
        while True:
            t = np.sort(rng.uniform(0.0, 60.0 * MINUTES, n))
            close = np.flatnonzero(np.diff(t) < MIN_HEADWAY_S)
            t[close + 1] = t[close] + MIN_HEADWAY_S
            if np.diff(t).min() >= MIN_HEADWAY_S:
                break
        out += [(float(at), is_north, float(rng.normal(SPEED, SPEED_STD))) for at in t]
    return sorted(out)


def passings(simulator, seed):
    """Simulate all vehicles; return [`Passing`]."""
    rng = np.random.default_rng([seed, len(simulator)])
    plan = arrivals(rng)
    bodies = [(truck if rng.random() < TRUCKS else car)(rng, simulator) for _ in plan]
    gain = 1.0 + 0.01 * rng.standard_normal((2, 2))
    lateral = LANE_M + 0.3 * rng.standard_normal(len(plan))
    half = WINDOW_S / 2.0 + PAD_S
    t, out = np.arange(-half, half, 1.0 / RATE), []
    times = np.array([p[0] for p in plan])
    for k, (at, is_north, _) in enumerate(plan):
        near = np.flatnonzero(np.abs(times - at) < half + 2.0)
        B = sum(field_of(bodies[i], plan[i], lateral[i], at + t) for i in near)
        B = np.clip(gain[:, None] * B + OFFSET_STD * rng.standard_normal((2, 1, 2))
                    + NOISE * rng.standard_normal(B.shape), -SATURATION, SATURATION)
        others = np.abs(np.delete(times, k) - at)
        out.append(Passing(t, B, is_north, float(others.min())))
    return out


def field_of(body, arrival, lateral, t):
    """Field (2, n, 2) [T] of a vehicle on both axes of both sensors at times (n,) [s]."""
    at, is_north, speed = arrival
    sign = 1.0 if is_north else -1.0
    position = np.stack([sign * speed * (t - at), np.full(len(t), -sign * lateral)], axis=1)
    heading = np.full(len(t), 0.0 if is_north else np.pi)
    return body.field(EARTH, position, heading, SENSORS)[..., :2].swapaxes(0, 1)


@dataclass(frozen=True)
class Shares:
    """Fractions of correct directions from the near sensor, the far sensor and their fusion."""

    near: float
    far: float
    fused: float


def shares(vehicles, log_odds):
    """Compute the `Shares` of [`Passing`] from [([log odds of each sensor], fused log odds)]."""
    north = np.array([v.is_north for v in vehicles])
    near = np.array([v.near for v in vehicles])
    single = (np.array([each for each, _ in log_odds]) > 0.0) == north[:, None]
    rows = np.arange(len(near))
    return Shares(*(float(np.mean(right)) for right in (
        single[rows, near], single[rows, 1 - near],
        (np.array([fused for _, fused in log_odds]) > 0.0) == north)))


def far_sensor_error(vehicles):
    """Probability of a wrong direction from the far sensor, isolated vehicles: (predicted,
    measured)."""
    isolated = [v for v in vehicles if v.headway > 2.0]
    far = [(v.log_odds_of_north()[0][1 - v.near], v.is_north) for v in isolated]
    predicted = [1.0 / (1.0 + np.exp(min(abs(odds), 500.0))) for odds, _ in far]
    return float(np.mean(predicted)), float(np.mean([(odds > 0.0) != north for odds, north in far]))
