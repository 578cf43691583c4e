"""Worlds with several vehicles at once, and a score of the tracks of each vehicle.

The traffic (meeting, following, free) resembles the bundled recordings. The vehicles and sensors
differ: bodies of boxes with spinning wheels, drivers who brake and swerve, gain errors.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
from mag_tracking.simulation.scenario import Path, body_poses
from support.box_vehicles import random_drive
from support.passes import network_of
from support.random_passes import are_wrong, errors_of
from support.situation_worlds import car, truck
from support.worlds import FLAWS, world

NETWORKS = {
    2: network_of([[0.0, -5.5, 0.0], [0.0, 5.5, 0.0]]),
    4: network_of([[-3.0, -5.5, 0.0], [3.0, 5.5, 0.0], [-3.0, 5.5, 0.0], [3.0, -5.5, 0.0]]),
    8: network_of([[6.0 * k - 21.0, 5.5 * (-1.0)**k, 0.0] for k in range(8)])}
LEAD_S, RATE = 12.0, 50.0
NEAR_M = 8.0
"""[m] Errors of a track are evaluated within this distance of the origin."""
LANE_M = 1.75
TRUCKS = 0.1
"""Proportion of long vehicles."""


@dataclass(frozen=True)
class WheeledVehicle:
    """Body with a steel belt in each of four tyres, which rotates as the vehicle moves."""

    body: object
    moments: np.ndarray
    """Two components of each belt's moment perpendicular to the axle, (4, 2) A m²."""
    radius: float = 0.3

    def field(self, earth_field, position, heading, points):
        """Field of the vehicle at `points`; a body of `support.scenario`."""
        B = self.body.field(earth_field, position, heading, points)
        R, origin = body_poses(position, heading)
        distance = np.concatenate([[0.0], np.hypot(*np.diff(position[:, :2], axis=0).T).cumsum()])
        for k, (x, y) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            a = distance / self.radius + 1.7 * k
            ahead, up = self.moments[k]
            m = np.stack([ahead * np.cos(a) - up * np.sin(a), np.zeros_like(a),
                          ahead * np.sin(a) + up * np.cos(a)], axis=1)
            wheel = origin + np.einsum('nij,j->ni', R, [0.3 * self.body.length * x, 0.75 * y,
                                                        self.radius])
            moment = np.einsum('nij,nj->ni', R, m)
            B = B + dipole_field(points[None] - wheel[:, None],
                                 np.broadcast_to(moment[:, None], (*moment.shape[:1],
                                                                   len(points), 3)))
        return B


def vehicle(rng, simulator, trucks=TRUCKS):
    """Random car, or truck with probability `trucks`; a vehicle of boxes has rotating wheels."""
    body = (truck if rng.random() < trucks else car)(rng, simulator)
    return WheeledVehicle(body, rng.normal(0.0, 2.0, (4, 2))) if simulator == 'boxes' else body


def passing(rng, simulator, at_s, direction, speed, trucks=TRUCKS):
    """Random vehicle that passes the origin at `at_s` [s]; return (body, course)."""
    lane = -direction * (LANE_M + rng.uniform(-0.3, 0.3))
    path = Path(np.array([-direction * speed * at_s, lane]), 0.0 if direction > 0 else np.pi, speed)
    body = vehicle(rng, simulator, trucks)
    return body, random_drive(rng, path, at_s) if simulator == 'boxes' else path


def pair(rng, pattern, at_s):
    """Draw two vehicles that meet or follow: [(time [s], direction, speed [m/s])]."""
    speed, direction = rng.uniform(8.0, 20.0), int(rng.choice([-1, 1]))
    if pattern == 'meeting':
        return [(at_s, direction, speed),
                (at_s + rng.uniform(0.1, 1.1), -direction, rng.uniform(8.0, 20.0))]
    return [(at_s, direction, speed),
            (at_s + rng.uniform(1.2, 2.5), direction, speed * rng.uniform(0.96, 1.04))]


def busy(pattern, n_sensors, simulator, seed, n=4, trucks=TRUCKS):
    """Simulate a `World` with `n` pairs of vehicles, or with up to 3 `n` vehicles in free traffic.

    `pattern` is 'meeting', 'following' or 'traffic'.
    """
    rng = np.random.default_rng([seed, n_sensors, len(pattern), len(simulator)])
    if pattern == 'traffic':
        times = LEAD_S + np.cumsum(rng.exponential(3.0, 3 * n))
        plan = [(t, int(rng.choice([-1, 1])), rng.uniform(8.0, 20.0)) for t in times]
        plan = [p for k, p in enumerate(plan) if not any(
            # Vehicles do not drive through other vehicles in the same lane.
            q[1] == p[1] and (p[0] - q[0]) * min(p[2], q[2]) < 14.0 for q in plan[:k])]
    else:
        plan = [p for k in range(n) for p in pair(rng, pattern, LEAD_S + 14.0 * k)]
    movers = [passing(rng, simulator, *p, trucks) for p in plan]
    return world(NETWORKS[n_sensors], movers, max(p[0] for p in plan) + 7.0, rng,
                 FLAWS[simulator], RATE)


@dataclass(frozen=True)
class Score:
    """Agreement of a set of tracks with a set of vehicles."""

    rms: np.ndarray
    """RMS error within `NEAR_M` of the origin, (n_vehicles,) m. NaN without a track."""
    nees: np.ndarray
    """Median NEES with two degrees of freedom, (n_vehicles,). NaN without a track."""
    is_found: np.ndarray
    """Whether a vehicle has an accurate track in the right direction, (n_vehicles,)."""
    n_extra: int
    """Number of tracks that belong to no vehicle."""
    n_unflagged: int
    """Number of unflagged poses."""
    n_wrong: int
    """Number of unflagged poses that are wrong for every vehicle."""

    def __str__(self):
        return (f'found {self.is_found.sum()} of {len(self.rms)}, RMS {np.nanmedian(self.rms):.2f} '
                f'm, NEES {np.nanmedian(self.nees):.2f}, extra tracks {self.n_extra}, unflagged '
                f'poses {self.n_unflagged}, of which wrong {self.n_wrong}')


FOUND_M = 5.0
"""[m] Maximum RMS error of a track that belongs to a vehicle."""


def score(poses, vehicles):
    """Compute the `Score` of `Track` records for vehicles [(t (n,) [s], position (n, 2) [m])]."""
    of_track = {i: [p for p in poses if p.id == i] for i in sorted({p.id for p in poses})}
    candidates, unflagged = [], [p for p in poses if not p.ambiguous]
    wrong = np.ones(len(unflagged), dtype=bool)
    for k, (t, position) in enumerate(vehicles):
        wrong &= are_wrong(*errors_of(unflagged, t, position)[:2]) | _outside(unflagged, t)
        for i, own in of_track.items():
            error, _, nees, true = errors_of(own, t, position)
            near = (np.hypot(*true.T) < NEAR_M) & ~_outside(own, t)
            if near.any():
                ends = np.interp([own[0].stamp_ns / 1e9, own[-1].stamp_ns / 1e9], t,
                                 position[:, 0])
                velocity = np.median([p.velocity[0] for p, n in zip(own, near, strict=True) if n])
                candidates.append((float(np.sqrt(np.mean(error[near]**2))), i, k,
                                   2.0 * float(np.median(nees[near])),
                                   bool(velocity * (ends[1] - ends[0]) > 0.0)))
    n = len(vehicles)
    rms, nees, found = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, dtype=bool)
    used = set()
    for error, i, k, of_k, goes_right in sorted(candidates):
        if i not in used and np.isnan(rms[k]):
            used.add(i)
            rms[k], nees[k], found[k] = error, of_k, goes_right and error < FOUND_M
    return Score(rms, nees, found, len(set(of_track) - used), len(unflagged), int(wrong.sum()))


def _outside(poses, t):
    """Whether the time of each pose is outside the times `t` of the true trajectory, (n,)."""
    stamps = np.array([p.stamp_ns for p in poses]) / 1e9
    return (stamps < t[0]) | (stamps > t[-1])


def tracked(a_world, changes=None):
    """Track a `World`; return (`Score`, `Pipeline`)."""
    pipeline = Pipeline(a_world.network, settings_for('vehicle', changes))
    records = pipeline.feed(a_world.readings) + pipeline.flush()
    poses = [r for r in records if isinstance(r, Track) and not r.ended]
    return score(poses, [(a_world.t, position) for position in a_world.positions]), pipeline
