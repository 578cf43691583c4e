"""Stopped vehicles in the worlds of `support.situations`: tracks, and recovery of the
backgrounds."""

import numpy as np

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
from mag_tracking.stages.calibrate.prescan import prescan
from support.random_passes import SIMULATORS, errors_of
from support.situations import simulated_world, wrong_of

STOPS = ('stops for 5 s', 'stops for 20 s', 'stops for 60 s')
MAX_STOPPED_SPEED = 0.05
"""[m/s] Speed below which a vehicle counts as stopped."""
MAX_BACKGROUND_ERROR = 2.0
"""Maximum error of a correct background, in standard deviations of a reading."""
MAX_RECOVERY_S = 3.0
"""[s] Maximum time from the departure of a parked vehicle until the background is correct."""
TRACKED_M = 2.0
"""[m] Maximum median error of a tracked vehicle."""
BATCH_SIZE = 50
"""Number of readings per batch."""


def poses_of(records):
    return [r for r in records if isinstance(r, Track) and not r.ended]


def stop_interval(a_world, body=0):
    """Interval in which a body of a `World` is stopped: (begin, end) [s]."""
    velocity = np.gradient(a_world.positions[body], a_world.t, axis=0)
    still = a_world.t[np.linalg.norm(velocity, axis=1) < MAX_STOPPED_SPEED]
    return still.min(), still.max()


def is_one_track(name, run):
    """Whether one track covers a vehicle from before its stop until 2 s after the stop."""
    a_world = simulated_world(name, SIMULATORS[run % 2], run // 2)
    pipeline = Pipeline(a_world.network, settings_for('vehicle'))
    poses = poses_of(pipeline.feed(a_world.readings) + pipeline.flush())
    begin, end = stop_interval(a_world)
    spans = {}
    for pose in poses:
        spans.setdefault(pose.id, []).append(pose.stamp_ns / 1e9)
    return any(times[0] < begin and times[-1] > end + 2.0 for times in spans.values())


def background_recovery_s(run):
    """Time [s] from a vehicle's departure until all backgrounds remain correct; inf if never."""
    # The vehicle has left when no sensor differs from its final level by more than
    # `MAX_BACKGROUND_ERROR`. The stage runs as in live operation, without a prescan.
    a_world = simulated_world('there at the start, leaves', SIMULATORS[run % 2], run // 2)
    stage = Pipeline(a_world.network, settings_for('vehicle')).calibrate
    readings, names = a_world.readings, a_world.network.names
    n = len(names)
    field = readings.field.reshape(-1, n, 3)
    latest = a_world.t > a_world.t[-1] - 3.0
    level, std = field[latest].mean(axis=0), field[latest].std(axis=0)
    width = 25
    smooth = np.stack([[np.convolve(field[:, j, a], np.ones(width) / width, 'same')
                        for a in range(3)] for j in range(n)]).transpose(2, 0, 1)
    deviates = (np.abs(smooth - level) > MAX_BACKGROUND_ERROR * std).any(axis=(1, 2))[width:-width]
    departure = a_world.t[width + np.flatnonzero(deviates).max()]
    times, is_correct = [], []
    for a in range(0, len(readings), BATCH_SIZE):
        stage.feed(readings.part(slice(a, a + BATCH_SIZE)))
        times.append(readings.stamp_ns[min(a + BATCH_SIZE, len(readings)) - 1] / 1e9)
        is_correct.append(not stage.unready() and all(
            (np.abs(stage.background(name) - level[j]) < MAX_BACKGROUND_ERROR * std[j]).all()
            for j, name in enumerate(names)))
    wrong = np.flatnonzero(~np.array(is_correct))
    return np.inf if wrong.max() == len(times) - 1 else max(
        times[wrong.max() + 1] - departure, 0.0)


def error_after_parked(run):
    """Track the first vehicle after a parked vehicle: (median error [m], n_unflagged, n_wrong).

    The readings are processed offline, with a prescan. The error is inf without a track.
    """
    a_world = simulated_world('there at the start, then cars', SIMULATORS[run % 2], run // 2)
    pipeline = Pipeline(a_world.network, settings_for('vehicle'))
    prescan([a_world.readings], a_world.network,
            pipeline.settings.calibrate).apply(pipeline.calibrate)
    poses = poses_of(pipeline.feed(a_world.readings) + pipeline.flush())
    best = np.inf, 0, 0
    for id in {pose.id for pose in poses}:
        own = [pose for pose in poses if pose.id == id]
        error = float(np.median(errors_of(own, a_world.t, a_world.positions[1])[0]))
        unflagged = np.array([not pose.ambiguous for pose in own])
        best = min(best, (error, int(unflagged.sum()),
                          int((unflagged & wrong_of(own, a_world)).sum())))
    return best
