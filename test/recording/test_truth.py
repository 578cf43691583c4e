"""Truth from topics of two message types and from tables; trajectory files."""

import csv
import dataclasses

import numpy as np
import pytest

from mag_tracking.analysis.track_errors import magnet_errors
from mag_tracking.analysis.track_log import SmoothedLog
from mag_tracking.apps.replay import replay, write_trajectories
from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import header_dict
from mag_tracking.messages.types import (
    MAGNETIC_FIELD,
    POSE,
    POSE_WITH_COVARIANCE,
    RawMessage,
    encoder,
    schema_of,
)
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.message_block import MessageBlock
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.truth import TruthTopics, read_truth_table
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.results.track_files import write_tum
from support.bundled import QUICK, vehicle_path
from support.counters import assert_counts
from support.networks import line_network
from support.samples import MagSample, sample_dict

NAME = 'straight_car_fast_left'


def pose(x):
    """Content of a geometry_msgs/Pose at (x, 2, 3)."""
    return {'position': {'x': x, 'y': 2.0, 'z': 3.0}, 'orientation': {'w': 1.0}}


def recording_of(path, frame):
    """Write a recording with a field, and with poses of two message types on two topics."""
    sample = MagSample(10**9, 'mag_1', [0.0, 0.0, 0.0])
    with RecordingWriter(path) as writer:
        writer.write('/mag_1/imu/mag', MAGNETIC_FIELD, sample_dict(sample, 'mag_1'), 10**9)
        for k in (2, 1):
            header = header_dict(k * 10**9 + 7, frame)
            writer.write('/gnss/pose', POSE, {'header': header, 'pose': pose(float(k))}, k * 10**9)
            writer.write('/slam', POSE_WITH_COVARIANCE, {
                'header': header, 'pose': {'pose': pose(10.0 * k), 'covariance': [0.0] * 36}},
                k * 10**9)
    return Recording(path)


def truth_of(recording, topic, network=None):
    """Read a recording; return its truth arrays and the number of rejections by cause."""
    reader = SampleReader(recording, network or line_network(2), topic)
    list(reader.readings())
    return reader.truth_arrays(), dict(reader.rejected)


def test_poses_of_either_type_become_chronological_truth(tmp_path):
    recording = recording_of(tmp_path / 'a.mcap', 'map')
    assert truth_of(recording, None) == ({}, {})
    for topic, name, first in (('/gnss/pose', '/gnss', 1.0), ('/slam', '/slam', 10.0)):
        arrays, rejected = truth_of(recording, topic)
        assert list(arrays) == [name] and not rejected
        stamps, position, quaternion = arrays[name]
        assert stamps.tolist() == [10**9 + 7, 2 * 10**9 + 7]
        assert position.tolist() == [[first, 2.0, 3.0], [2.0 * first, 2.0, 3.0]]
        assert quaternion.tolist() == [[0.0, 0.0, 0.0, 1.0]] * 2


def test_poses_are_read_in_blocks_and_sorted_by_timestamp():
    """Messages in other frames or encodings are not read in blocks."""
    def message(topic, stamp_ns, frame='map', kind=POSE):
        return RawMessage(topic, kind, 0, encoder(POSE)({
            'header': header_dict(stamp_ns, frame), 'pose': pose(float(stamp_ns))}),
            schema_of(POSE))

    topics = TruthTopics('/ground_truth/', 'map')
    block = MessageBlock.of_messages([
        message('/ground_truth/car/pose', 30), message('/ground_truth/car/pose', 20),
        message('/ground_truth/car/pose', 10, 'utm'), message('/elsewhere', 40),
        message('/ground_truth/truck/pose', 50)])
    assert sorted(topics.add_block(block).tolist()) == [0, 1, 4]
    coded = MessageBlock(block.data, {n: kind._replace(encoding='json')
                                      for n, kind in block.kinds.items()}, block.channel,
                         block.log_time_ns, block.begin, block.end)
    assert not len(topics.add_block(coded))
    assert not len(topics.add_block(block.part(slice(0, 0))))
    arrays = topics.arrays()
    assert list(arrays) == ['car', 'truck']
    stamps, position, _ = arrays['car']
    assert stamps.tolist() == [20, 30] and position[:, 0].tolist() == [20.0, 30.0]


def test_truth_in_another_frame_is_rejected_with_a_reason(tmp_path):
    recording = recording_of(tmp_path / 'a.mcap', 'odom')
    found, rejected = truth_of(recording, '/slam')
    assert not found
    assert_counts(rejected, {'odom': 2})
    network = dataclasses.replace(line_network(2), frame='odom')
    assert list(truth_of(recording, '/slam', network)[0]) == ['/slam']


@pytest.mark.parametrize('topic, message', [
    ('/nowhere', 'topics with poses: /gnss/pose'),
    ('nowhere', 'topic /nowhere has'),
    ('/mag_1/imu/mag', 'sensor_msgs/msg/MagneticField')])
def test_a_topic_without_poses_is_refused_as_truth(tmp_path, topic, message):
    with pytest.raises(RecordingError, match=message):
        truth_of(recording_of(tmp_path / 'a.mcap', 'map'), topic)


def test_a_table_gives_the_same_errors_as_the_topic(tmp_path, road_network):
    """The track errors are the same, whether the times in the table are in ns or in s."""
    settings = settings_for('vehicle', QUICK)
    run = replay(Recording(vehicle_path(NAME)), road_network, settings, tmp_path / 'a')
    ((stamps, position, _),) = run.truth.values()
    expected = run.summary['tracks'][0]['truth']
    for column, times in (('stamp_ns', stamps.tolist()),
                          ('t', [f'{t // 10**9}.{t % 10**9:09d}' for t in stamps.tolist()])):
        path = tmp_path / f'by_{column}.csv'
        with open(path, 'w', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow([column, 'comment', 'x', 'y'])
            writer.writerows([t, 'text', repr(x), repr(y)] for t, (x, y) in zip(
                times, position[:, :2].tolist(), strict=True))
        found = replay(Recording(vehicle_path(NAME)), road_network, settings, tmp_path / 'b',
                       truth=str(path)).summary['tracks'][0]['truth']
        assert found['name'] == f'by_{column}'
        for key in ('rms', 'closest', 'anees'):
            assert found[key] == pytest.approx(expected[key], rel=1e-3)


@pytest.mark.parametrize('text, message', [
    ('t,y\n1,2\n', 'column x'), ('x,y\n1,2\n', 'column stamp_ns, t or'),
    ('t,x,y,qx,qy,qz\n1,2,3,0,0,0\n', 'column qw'),
    ('t,x,y,mx\n1,2,3,0\n', 'column my'),
    ('t,x,y\n1,2\n', 'row 2: expected 3 columns'), ('t,x,y\n1,2,north\n', "row 2: y is 'north'"),
    ('t,x,y\n,1,2\n', 'row 2: t'), ('t,x,y\n', 'no rows'),
    ('t,x,y\n1,2,inf\n', 'row 2: y'),
    ('stamp_ns,x,y\n\u00b2,1,2\n', 'row 2: stamp_ns'), ('t,x,y\n1e300,1,2\n', 'valid time'),
    ('stamp_ns,x,y\n99999999999999999999999,1,2\n', 'valid time')])
def test_an_invalid_truth_table_is_refused(tmp_path, text, message):
    (tmp_path / 'truth.csv').write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_truth_table(tmp_path / 'truth.csv')


def test_a_table_with_a_byte_order_mark_is_read(tmp_path):
    (tmp_path / 'truth.csv').write_text('t,x,y\n2,3,4\n1,1,2\n', encoding='utf-8-sig')
    stamps, position, quaternion = read_truth_table(tmp_path / 'truth.csv')['truth']
    assert stamps.tolist() == [10**9, 2 * 10**9]
    assert position.tolist() == [[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]
    assert quaternion.shape == (2, 4) and np.isnan(quaternion).all()


@pytest.mark.parametrize('columns, row, expected', [
    ('qx,qy,qz,qw', '0,0,0,1', 45.0), ('mx,my,mz', '1,0,0', 45.0), ('mx,my,mz', '0,0,-2', 135.0),
    ('mx,my,mz', '0,0,0', None), ('note', 'none', None)])
def test_the_axis_of_a_magnet_is_compared_only_with_true_orientations(tmp_path, columns, row,
                                                                      expected):
    """The magnet is magnetised along its x axis; its track has a moment between x and z."""
    (tmp_path / 'truth.csv').write_text(f't,x,y,z,{columns}\n' + f'0,0,0,0,{row}\n1,0,0,0,{row}\n')
    axis = (1.0, 0.0, 0.0)
    (truth,) = read_truth_table(tmp_path / 'truth.csv', axis).values()
    log = SmoothedLog(1)
    log.stamp_ns, log.position = [0, 10**9], [np.zeros(3)] * 2
    log.moment, log.covariance = [np.array([1.0, 0.0, 1.0])] * 2, [np.eye(6)] * 2
    errors = magnet_errors(log, truth, axis, 0)
    assert errors['axis_median_deg'] == (expected if expected is None else pytest.approx(expected))


def test_a_pose_with_a_quaternion_of_zeros_has_no_true_orientation():
    zeros = {**pose(1.0), 'orientation': {'w': 0.0}}
    topics = TruthTopics('/ground_truth/', 'map')
    topics.add_block(MessageBlock.of_messages([RawMessage('/ground_truth/a/pose', POSE, 0, encoder(
        POSE)({'header': header_dict(1, 'map'), 'pose': zeros}), schema_of(POSE))]))
    assert np.isnan(topics.arrays()['a'][2]).all()


def test_a_missing_table_is_reported(tmp_path, road_network):
    with pytest.raises(RecordingError, match='cannot read .*missing.csv'):
        replay(Recording(vehicle_path(NAME)), road_network, settings_for('vehicle'), tmp_path,
               truth=str(tmp_path / 'missing.csv'))


def test_trajectory_files_contain_the_track(tmp_path, vehicle_replays):
    run, _ = vehicle_replays[NAME]
    paths = write_trajectories(run, tmp_path)
    assert [p.name for p in paths] == ['track_1.tum', 'track_1_smoothed.tum']
    log = run.logs[1]
    rows = np.loadtxt(paths[0])
    np.testing.assert_allclose(rows[:, 1:4], log.position, rtol=1e-8)
    np.testing.assert_allclose(rows[:, 4:], log.orientation, atol=1e-8)
    text = paths[0].read_text().split()[0]
    assert text == f'{log.stamp_ns[0] // 10**9}.{log.stamp_ns[0] % 10**9:09d}'
    write_tum(tmp_path / 'none.tum', [], [], [])
    assert (tmp_path / 'none.tum').read_text() == '\n'
