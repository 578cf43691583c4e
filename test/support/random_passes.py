"""Random passes of vehicles from both simulators, and their tracks."""

from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.simulation.scenario import Path, random_vehicle
from support.box_vehicles import UNCALIBRATED, box_car, box_truck, random_drive
from support.bundled import NETWORK_FILE
from support.samples import scenario
from support.scenario import SensorErrorModel
from support.spoiler import apply

SIMULATORS = ('clouds', 'boxes')
KINDS = ('truck', 'car', 'turning')
WRONG_M, WRONG_SD = 2.0, 3.0
"""A pose is wrong if its error exceeds both WRONG_M [m] and WRONG_SD standard deviations."""


def random_course(rng, turns):
    """Random course past sensors at the origin: (`Path`, duration [s], time near the CPA [s])."""
    # A turn has a lateral acceleration of 2 to 5 m/s², like a tight turn at a junction.
    lane, radius = rng.uniform(0.8, 1.6), rng.uniform(4.5, 8.0)
    speed = np.sqrt(radius * rng.uniform(2.0, 5.0)) if turns else rng.uniform(7.0, 20.0)
    lead = 6.0 * speed + (15.0 if turns else 25.0)
    start = np.array([-lead, -lane])
    if not turns:
        return Path(start, 0.0, speed), 8.0 + 50.0 / speed, lead / speed
    before = lead + rng.uniform(3.5, 5.5) - radius
    return (Path(start, 0.0, speed, before, -0.5 * np.pi, radius), 8.0 + 40.0 / speed,
            lead / speed)


def random_pass(simulator, kind, seed):
    """Random pass of a kind in `KINDS`: (body, course, duration [s], `SensorErrorModel`)."""
    rng = np.random.default_rng([seed, KINDS.index(kind), SIMULATORS.index(simulator)])
    path, duration, closest_s = random_course(rng, kind == 'turning')
    if simulator == 'clouds':
        body = (random_vehicle(rng, rng.uniform(7.0, 16.0), 2.4, 2.8,
                               moment=rng.uniform(1200.0, 2200.0)) if kind == 'truck' else
                random_vehicle(rng, rng.uniform(3.6, 4.8), moment=rng.uniform(300.0, 600.0)))
        return body, path, duration, SensorErrorModel()
    body = (box_truck if kind == 'truck' else box_car)(rng)
    return body, random_drive(rng, path, closest_s), duration + 3.0, UNCALIBRATED


@dataclass(frozen=True)
class Tracked:
    """Tracking results of one pass; the arrays have one element per pose."""

    error: np.ndarray
    """Horizontal error, (n,) m."""
    error_std: np.ndarray
    """Published standard deviation in the direction of the error, (n,) m."""
    nees: np.ndarray
    """NEES per axis, (n,)."""
    topic_nees: np.ndarray
    """NEES per axis by the covariance of the pose topics, (n,). NaN for withheld poses."""
    distance: np.ndarray
    """True distance from the centre of the sensors, (n,) m."""
    ambiguous: np.ndarray
    """Whether the pose is flagged as ambiguous, (n,)."""
    speed_ratio: float
    """Tracked speed divided by true speed at the CPA. NaN without a pose."""
    heading: float
    """Cosine of the angle between tracked and true velocity at the CPA; NaN without a pose."""
    detected: bool
    smoothed_unflagged: int
    """Number of unflagged smoothed poses."""
    smoothed_wrong: int
    """Number of unflagged smoothed poses that are wrong."""

    @property
    def unflagged_and_wrong(self):
        """Whether each pose is wrong and not flagged, (n,)."""
        return ~self.ambiguous & are_wrong(self.error, self.error_std)


def are_wrong(error, error_std):
    """Whether each error [m] exceeds both `WRONG_M` and `WRONG_SD` times `error_std` [m]."""
    return (error > WRONG_M) & (error > WRONG_SD * error_std)


def errors_of(poses, t, position):
    """Horizontal errors of poses: (error [m], its std [m], NEES per axis, true position [m])."""
    stamps = np.array([r.stamp_ns for r in poses]) / 1e9
    true = np.stack([np.interp(stamps, t, position[:, k]) for k in (0, 1)], axis=1)
    error = np.array([r.position[:2] for r in poses]).reshape(-1, 2) - true
    P = np.array([r.covariance[:2, :2] for r in poses]).reshape(-1, 2, 2)
    distance = np.hypot(*error.T)
    std = np.sqrt(np.einsum('ni,nij,nj->n', error, P, error)) / np.maximum(distance, 1e-9)
    nees = np.einsum('ni,ni->n', error, np.linalg.solve(P, error[:, :, None])[:, :, 0]) / 2
    return distance, std, nees, true


def tracked(network, body, course, duration, flaws, seed, changes=None, faults=()):
    """Simulate a pass with `faults` of `support.spoiler`, and track it; return `Tracked`."""
    readings, t, position, _ = scenario.simulate(network, body, course, 100.0, duration,
                                                 np.random.default_rng(seed), flaws)
    readings = apply(readings, *faults)
    pipeline = Pipeline(network, settings_for('vehicle', changes))
    records = pipeline.feed(readings) + pipeline.flush()
    tracks = [r for r in records if isinstance(r, Track) and not r.ended]
    error, std, nees, true = errors_of(tracks, t, position)
    topic_nees = np.full(len(tracks), np.nan)
    published = [k for k, r in enumerate(tracks) if r.topic_uncertainty is not None]
    topic_nees[published] = errors_of([replace(tracks[k], covariance=tracks[
        k].topic_uncertainty.covariance) for k in published], t, position)[2]
    velocity = np.gradient(position, t, axis=0)
    distance = np.hypot(*(true - network.centre[:2]).T)
    ratio = heading = np.nan
    if len(tracks):
        k = int(np.argmin(distance))
        v = np.array([np.interp(tracks[k].stamp_ns / 1e9, t, v) for v in velocity.T[:2]])
        w = tracks[k].velocity[:2]
        ratio = np.hypot(*w) / np.hypot(*v)
        heading = w @ v / np.hypot(*w) / np.hypot(*v)
    unflagged = [r for r in records if isinstance(r, SmoothedPose) and not r.ambiguous]
    smoothed_error, smoothed_std, *_ = errors_of(unflagged, t, position)
    ambiguous = np.array([r.ambiguous for r in tracks], dtype=bool)
    return Tracked(error, std, nees, topic_nees, distance, ambiguous,
                   float(ratio), float(heading), pipeline.detect.counts['onsets'] > 0,
                   len(unflagged), int(are_wrong(smoothed_error, smoothed_std).sum()))


def one_random_pass(simulator, kind, seed, changes=None, faults=()):
    """Simulate a random pass with `faults`, and track it with the settings `changes`.

    The network is the bundled network. Returns `Tracked`.
    """
    return tracked(read_network(NETWORK_FILE), *random_pass(simulator, kind, seed), seed, changes,
                   faults)
