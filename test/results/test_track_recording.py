"""`tracks.mcap`, read by an independent library, contains all messages for ROS viewers."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from mag_tracking.messages.standard import SENSOR_NAMESPACES, TRACK_NAMESPACES

TOPICS = {'/mag_1/imu/mag_calibrated', '/mag_2/imu/mag_calibrated', '/tf', '/tf_static',
          *(f'/tracker_node/{name}' for name in (
              'tracks', 'pose', 'odometry', 'path', 'markers', 'sensor_markers', 'smoothed',
              'path_smoothed'))}


@pytest.fixture(scope='module')
def read(vehicle_replays):
    """Read a replay; return `Run`, {topic: [(log time [ns], message)]} and {topic: durability}."""
    run, folder = vehicle_replays['straight_car_right']
    messages, durability = {}, {}
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, time_ns, raw in reader.messages():
            messages.setdefault(connection.topic, []).append(
                (time_ns, reader.deserialize(raw, connection.msgtype)))
            durability[connection.topic] = connection.ext.offered_qos_profiles[0].durability.name
    return run, messages, durability


def test_every_topic_is_recorded(read):
    _, messages, durability = read
    assert messages.keys() == TOPICS
    latched = {topic for topic, name in durability.items() if name == 'TRANSIENT_LOCAL'}
    assert latched == {'/tf_static', '/tracker_node/sensor_markers'}
    # The positions of the sensors have the log time of the first message.
    first = min(time_ns for rows in messages.values() for time_ns, _ in rows)
    assert all(messages[topic][0][0] == first and len(messages[topic]) == 1 for topic in latched)


def test_each_pose_has_its_odometry_transform_and_markers(read):
    run, messages, _ = read
    log = run.logs[1]
    n = len(log.stamp_ns)
    unambiguous = [k for k in range(n) if not log.ambiguous[k]]
    assert [len(messages[t]) for t in ('/tracker_node/pose', '/tracker_node/odometry', '/tf')] == [
        n, n, len(unambiguous)]
    for position, (_, odometry) in zip(log.position, messages['/tracker_node/odometry'],
                                       strict=True):
        p = odometry.pose.pose.position
        assert [p.x, p.y, p.z] == position.tolist() and odometry.child_frame_id == 'track_1'
    # A transform has no covariance, so ambiguous poses have no transform.
    for k, (_, tf) in zip(unambiguous, messages['/tf'], strict=True):
        (transform,) = tf.transforms
        t = transform.transform.translation
        assert [t.x, t.y, t.z] == log.position[k].tolist()
        assert transform.child_frame_id == 'track_1'
    arrays = [m.markers for _, m in messages['/tracker_node/markers']]
    assert len(arrays) == n + 1
    assert all([m.ns for m in markers] == list(TRACK_NAMESPACES) for markers in arrays)
    assert {m.action for m in arrays[-1]} == {2}
    sensors = messages['/tracker_node/sensor_markers'][0][1].markers
    assert {m.ns for m in sensors} == set(SENSOR_NAMESPACES)


def test_paths_contain_the_whole_track(read):
    run, messages, _ = read
    for topic, log in (('path', run.logs[1]), ('path_smoothed', run.smoothed[1])):
        ((_, path),) = messages[f'/tracker_node/{topic}']
        assert [[s.pose.position.x, s.pose.position.y] for s in path.poses] == [
            p[:2].tolist() for p in log.position]
    ((_, smoothed),) = messages['/tracker_node/smoothed']
    assert len(smoothed.poses) == len(run.smoothed[1].position)


def test_recorded_fields_equal_the_tracked_fields(read):
    run, messages, _ = read
    log = run.logs[1]
    for j in (0, 1):
        found = {time_ns: m.magnetic_field for time_ns, m in messages[
            f'/mag_{j + 1}/imu/mag_calibrated']}
        compared = [(found[stamp], field[j]) for stamp, field in zip(
            log.stamp_ns, log.measured, strict=True) if stamp in found]
        assert len(compared) > 0.5 * len(log.stamp_ns)
        for recorded, tracked in compared:
            np.testing.assert_array_equal([recorded.x, recorded.y, recorded.z], tracked)
