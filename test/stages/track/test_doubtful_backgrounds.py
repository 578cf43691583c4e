"""Tracks of frames in which a background is doubtful: ambiguous, and no others."""

import numpy as np
import pytest

from mag_tracking.messages.calibration_state import doubtful_times, sensor_dict
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.simulation.scenario import Path, random_vehicle
from mag_tracking.stages.track.manager import TrackManager
from support.bundled import NETWORK_FILE, QUICK
from support.dense_traffic import after_dense_traffic
from support.networks import line_network
from support.samples import one, simulate

SURE_WITHOUT = ('junction_left_to_right', 'junction_left_turns_to_rear')
DOUBTED = 'tracks with a doubtful background'
SETTINGS = settings_for('vehicle', QUICK)
"""A fast tracker: the doubt does not depend on the model of the target."""


@pytest.fixture(scope='module')
def passing():
    """(network, frames with a verdict) of a pass at 10 m/s; the last sensor is 150 m further on."""
    network = line_network(3, spacing=150.0, tilt=0.0)
    samples, *_ = simulate(network, random_vehicle(np.random.default_rng(1), length=4.0),
                           Path(np.array([-70.0, -1.2]), 0.0, 10.0), 100.0, 12.0,
                           np.random.default_rng(1))
    pipeline = Pipeline(network, settings_for('vehicle'))
    return network, [r for s in samples for r in pipeline.feed(one(s)) if isinstance(r, FieldFrame)]


def tracked(passing, times, settings=None):
    """(TrackManager, poses), with doubtful times of sensors [s]."""
    network, frames = passing
    manager = TrackManager(network, settings_for('vehicle', {**QUICK, **(settings or {})}).track)
    start = frames[0].stamp_ns
    manager.doubt({name: tuple((start + round(b * 1e9), None if e is None else
                                start + round(e * 1e9)) for b, e in segments)
                   for name, segments in times.items()})
    return manager, [r for f in frames for r in manager.feed(f)
                     if isinstance(r, Track) and not r.ended]


def test_a_track_of_a_doubtful_background_is_ambiguous(passing):
    """All of it, also where the doubt ended before the detection, but not before the lookback."""
    _, plain = tracked(passing, {})
    first = (plain[0].stamp_ns - passing[1][0].stamp_ns) / 1e9
    assert not all(t.ambiguous for t in plain)
    for begin, end in ((0.0, None), (first - 0.1, first), (0.0, first - 0.2)):
        manager, poses = tracked(passing, {'mag_2': [(begin, end)]})
        assert all(t.ambiguous for t in poses) and manager.counts[DOUBTED] == 1
        np.testing.assert_array_equal([t.position for t in poses], [t.position for t in plain])
    manager, poses = tracked(passing, {'mag_2': [(0.0, 0.2)]})
    assert [t.ambiguous for t in poses] == [t.ambiguous for t in plain]
    assert manager.counts[DOUBTED] == 0


def test_it_is_so_from_where_the_doubt_begins(passing):
    _, plain = tracked(passing, {})
    middle = plain[len(plain) // 2].stamp_ns
    begin = (middle - passing[1][0].stamp_ns) / 1e9
    manager, poses = tracked(passing, {'mag_1': [(begin, begin + 0.1)]})
    assert all(t.ambiguous for t in poses if t.stamp_ns >= middle) and manager.counts[DOUBTED] == 1
    assert [t.ambiguous for t in poses if t.stamp_ns < middle] \
        == [t.ambiguous for t in plain if t.stamp_ns < middle]


def test_sensors_that_a_track_does_not_use_are_no_matter(passing):
    two = {'track.max_sensors': 2}
    _, plain = tracked(passing, {}, two)
    unused = {name for name in passing[0].names if tracked(
        passing, {name: [(0.0, None)]}, two)[0].counts[DOUBTED] == 0}
    assert len(unused) == 1
    _, poses = tracked(passing, {unused.pop(): [(0.0, None)]}, two)
    assert [t.ambiguous for t in poses] == [t.ambiguous for t in plain]


def test_the_state_of_the_calibration_says_it():
    """As a message would: the latest stretch of each sensor, and nothing of those without."""
    network = read_network(NETWORK_FILE)
    pipeline = Pipeline(network, settings_for('vehicle'))
    assert said(pipeline) == {name: () for name in network.names}
    pipeline.feed(after_dense_traffic('straight_small_left', 7.0))
    times = pipeline.calibrate.doubtful_intervals()
    assert times
    assert said(pipeline) == {name: times.get(name, ())[-1:] for name in network.names}


def said(pipeline):
    """`doubtful_times` of the message that a calibration node would publish."""
    def as_object(content):
        if not isinstance(content, dict):
            return content
        return type('Message', (), {k: as_object(v) for k, v in content.items()})
    sensors = [as_object(sensor_dict(pipeline.calibrate, pipeline.network, j))
               for j in range(len(pipeline.network))]
    return doubtful_times(type('State', (), {'sensors': sensors}))


@pytest.mark.parametrize('name', SURE_WITHOUT)
def test_after_dense_traffic_a_vehicle_is_tracked_and_flagged(name):
    """Live there is no quiet stretch: nothing may be sure. The batches are no matter."""
    network, readings = read_network(NETWORK_FILE), after_dense_traffic(name, 7.0)
    pipeline, other = (Pipeline(network, SETTINGS) for _ in range(2))
    tracks = poses_of(pipeline.feed(readings) + pipeline.flush())
    assert pipeline.calibrate.doubtful_intervals()
    assert len(tracks) > 10 and all(t.ambiguous for t in tracks)
    parts = [other.feed(readings.part(slice(i, i + 50))) for i in range(0, len(readings), 50)]
    again = poses_of([r for part in parts for r in part] + other.flush())
    assert [(t.stamp_ns, t.ambiguous) for t in again] == [(t.stamp_ns, t.ambiguous) for t in tracks]


def poses_of(records):
    return [r for r in records if isinstance(r, Track) and not r.ended]


@pytest.mark.parametrize('name', SURE_WITHOUT)
def test_it_was_sure_before_it_knew_of_doubt(name):
    """Without the doubt many poses are sure, or the test above would show nothing."""
    pipeline = Pipeline(read_network(NETWORK_FILE), SETTINGS)
    pipeline.track.doubt = lambda times: None
    tracks = poses_of(pipeline.feed(after_dense_traffic(name, 7.0)) + pipeline.flush())
    assert sum(not t.ambiguous for t in tracks) > 10


def test_poses_of_a_fixed_lag_are_no_surer():
    pipeline = Pipeline(read_network(NETWORK_FILE),
                        settings_for('vehicle', {**QUICK, 'track.smoothing_lag_s': 0.5}))
    records = pipeline.feed(after_dense_traffic(SURE_WITHOUT[0], 7.0)) + pipeline.flush()
    smoothed = [r for r in records if isinstance(r, SmoothedPose)]
    assert len(smoothed) > 10 and all(s.ambiguous for s in smoothed)


def test_the_doubt_of_a_recording_outlasts_a_jump_back():
    """Played twice in one batch: the frames of the first are tracked when it is known of no more.
    """
    readings = after_dense_traffic(SURE_WITHOUT[0], 7.0)
    pipeline = Pipeline(read_network(NETWORK_FILE), SETTINGS)
    tracks = poses_of(pipeline.feed(Readings.joined([readings, readings])) + pipeline.flush())
    assert len(tracks) > 20 and all(t.ambiguous for t in tracks)
