"""Doubtful backgrounds make the tracks that use them ambiguous."""

import numpy as np
import pytest

from mag_tracking.calibration.doubtful_times import DOUBTFUL_BACKGROUND
from mag_tracking.messages.network import doubtful_times, sensor_dict
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.simulation.scenario import Path, random_vehicle
from mag_tracking.stages.track.manager import TrackManager
from support.bundled import NETWORK_FILE, QUICK
from support.dense_traffic import after_dense_traffic
from support.networks import line_network
from support.samples import one, simulate

UNAMBIGUOUS_WITHOUT_DOUBT = ('junction_left_to_right', 'junction_left_turns_to_rear')
DOUBTFUL_TRACKS = f'tracks with doubtful readings: {DOUBTFUL_BACKGROUND}'
SETTINGS = settings_for('vehicle', QUICK)
"""Settings of a fast target model; the doubt does not depend on the model."""


@pytest.fixture(scope='module')
def pass_frames():
    """(network, frames with detection results) of a pass at 10 m/s; one sensor is 150 m away from
    the others."""
    network = line_network(3, spacing=150.0, tilt=0.0)
    samples, *_ = simulate(network, random_vehicle(np.random.default_rng(1), length=4.0),
                           Path(np.array([-70.0, -1.2]), 0.0, 10.0), 100.0, 12.0,
                           np.random.default_rng(1))
    pipeline = Pipeline(network, settings_for('vehicle'))
    return network, [r for s in samples for r in pipeline.feed(one(s)) if isinstance(r, FieldFrame)]


def run_tracker(pass_frames, times, settings=None):
    """(TrackManager, poses) of the pass; `times` is {sensor: [(begin, end) of a doubtful
    interval]}.

    Times are relative to the first frame [s]; the end is None if the interval continues.
    """
    network, frames = pass_frames
    manager = TrackManager(network, settings_for('vehicle', {**QUICK, **(settings or {})}).track)
    start = frames[0].stamp_ns
    manager.set_input_doubts({DOUBTFUL_BACKGROUND: {
        name: tuple((start + round(b * 1e9), None if e is None else start + round(e * 1e9))
                    for b, e in segments) for name, segments in times.items()}})
    return manager, [r for f in frames for r in manager.feed(f)
                     if isinstance(r, Track) and not r.ended]


def test_a_track_with_a_doubtful_background_is_ambiguous(pass_frames):
    """The whole track is ambiguous, even if the doubt ended in the lookback before the
    detection."""
    _, plain = run_tracker(pass_frames, {})
    first = (plain[0].stamp_ns - pass_frames[1][0].stamp_ns) / 1e9
    assert not all(t.ambiguous for t in plain)
    for begin, end in ((0.0, None), (first - 0.1, first), (0.0, first - 0.2)):
        manager, poses = run_tracker(pass_frames, {'mag_2': [(begin, end)]})
        assert all(t.ambiguous for t in poses) and manager.counts[DOUBTFUL_TRACKS] == 1
        np.testing.assert_array_equal([t.position for t in poses], [t.position for t in plain])
    manager, poses = run_tracker(pass_frames, {'mag_2': [(0.0, 0.2)]})
    assert [t.ambiguous for t in poses] == [t.ambiguous for t in plain]
    assert manager.counts[DOUBTFUL_TRACKS] == 0


def test_poses_are_ambiguous_from_the_start_of_the_doubt(pass_frames):
    _, plain = run_tracker(pass_frames, {})
    middle = plain[len(plain) // 2].stamp_ns
    begin = (middle - pass_frames[1][0].stamp_ns) / 1e9
    manager, poses = run_tracker(pass_frames, {'mag_1': [(begin, begin + 0.1)]})
    assert all(t.ambiguous for t in poses if t.stamp_ns >= middle) \
        and manager.counts[DOUBTFUL_TRACKS] == 1
    assert [t.ambiguous for t in poses if t.stamp_ns < middle] \
        == [t.ambiguous for t in plain if t.stamp_ns < middle]


def test_doubtful_backgrounds_of_unused_sensors_have_no_effect(pass_frames):
    two_sensors = {'track.max_sensors': 2}
    _, plain = run_tracker(pass_frames, {}, two_sensors)
    unused = {name for name in pass_frames[0].names if run_tracker(
        pass_frames, {name: [(0.0, None)]}, two_sensors)[0].counts[DOUBTFUL_TRACKS] == 0}
    assert len(unused) == 1
    _, poses = run_tracker(pass_frames, {unused.pop(): [(0.0, None)]}, two_sensors)
    assert [t.ambiguous for t in poses] == [t.ambiguous for t in plain]


def test_the_calibration_state_message_contains_doubtful_intervals():
    """For each sensor, the message contains the latest doubtful interval, if there is one."""
    network = read_network(NETWORK_FILE)
    pipeline = Pipeline(network, settings_for('vehicle'))
    assert times_in_message(pipeline) == {name: () for name in network.names}
    pipeline.feed(after_dense_traffic('straight_small_left', 7.0))
    times = pipeline.calibrate.input_doubts()[DOUBTFUL_BACKGROUND]
    assert times_in_message(pipeline) == {name: times.get(name, ())[-1:] for name in network.names}


def times_in_message(pipeline):
    """`doubtful_times` of the message that a calibration node would publish."""
    def as_object(content):
        if not isinstance(content, dict):
            return content
        return type('Message', (), {k: as_object(v) for k, v in content.items()})
    sensors = [as_object(sensor_dict(pipeline.calibrate, pipeline.network, j))
               for j in range(len(pipeline.network))]
    return doubtful_times(type('State', (), {'sensors': sensors}))


@pytest.mark.parametrize('name', UNAMBIGUOUS_WITHOUT_DOUBT)
def test_a_vehicle_after_dense_traffic_is_tracked_and_ambiguous(name):
    """The data contain no quiet interval, so all poses are ambiguous, for any batch size."""
    network, readings = read_network(NETWORK_FILE), after_dense_traffic(name, 7.0)
    pipeline, other = (Pipeline(network, SETTINGS) for _ in range(2))
    tracks = poses_of(pipeline.feed(readings) + pipeline.flush())
    assert pipeline.calibrate.input_doubts()
    assert len(tracks) > 10 and all(t.ambiguous for t in tracks)
    parts = [other.feed(readings.part(slice(i, i + 50))) for i in range(0, len(readings), 50)]
    again = poses_of([r for part in parts for r in part] + other.flush())
    assert [(t.stamp_ns, t.ambiguous) for t in again] == [(t.stamp_ns, t.ambiguous) for t in tracks]


def poses_of(records):
    return [r for r in records if isinstance(r, Track) and not r.ended]


@pytest.mark.parametrize('name', UNAMBIGUOUS_WITHOUT_DOUBT)
def test_poses_after_dense_traffic_are_unambiguous_without_the_doubt(name):
    """The tracker ignores the doubtful intervals here. The ambiguity of these poses is therefore
    due to the intervals."""
    pipeline = Pipeline(read_network(NETWORK_FILE), SETTINGS)
    pipeline.track.set_input_doubts = lambda doubts: None
    tracks = poses_of(pipeline.feed(after_dense_traffic(name, 7.0)) + pipeline.flush())
    assert sum(not t.ambiguous for t in tracks) > 10


def test_fixed_lag_poses_after_dense_traffic_are_ambiguous():
    pipeline = Pipeline(read_network(NETWORK_FILE),
                        settings_for('vehicle', {**QUICK, 'track.smoothing_lag_s': 0.5}))
    records = pipeline.feed(after_dense_traffic(UNAMBIGUOUS_WITHOUT_DOUBT[0], 7.0)) \
        + pipeline.flush()
    smoothed = [r for r in records if isinstance(r, SmoothedPose)]
    assert len(smoothed) > 10 and all(s.ambiguous for s in smoothed)


def test_the_doubt_persists_after_a_jump_back_in_time():
    """The recording is fed twice in one batch, so calibration restarts before the first frames are
    tracked."""
    readings = after_dense_traffic(UNAMBIGUOUS_WITHOUT_DOUBT[0], 7.0)
    pipeline = Pipeline(read_network(NETWORK_FILE), SETTINGS)
    tracks = poses_of(pipeline.feed(Readings.joined([readings, readings])) + pipeline.flush())
    assert len(tracks) > 20 and all(t.ambiguous for t in tracks)
