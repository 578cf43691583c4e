"""Tracks and sensors as standard messages: transforms, detections, markers."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.messages.schema import pose_message_dict
from mag_tracking.messages.standard import (
    LIFETIME_S,
    SENSOR_NAMESPACES,
    TRACK_NAMESPACES,
    delete_markers,
    detections_3d_dict,
    sensor_markers,
    sensor_transform_dicts,
    track_markers,
    track_transform_dict,
)
from support.networks import line_network
from support.track_runs import magnet_frames


@pytest.fixture(scope='module')
def tracks():
    """Last unambiguous and last ambiguous `Track` of a replay: {is ambiguous: track}."""
    from mag_tracking.network.file import read_network
    from mag_tracking.pipeline import Pipeline, settings_for
    from mag_tracking.recording.reader import Recording
    from mag_tracking.recording.sample_reader import SampleReader
    from mag_tracking.records import Track
    from support.bundled import NETWORK_FILE, vehicle_path
    network = read_network(NETWORK_FILE)
    pipeline = Pipeline(network, settings_for('vehicle'))
    found = {}
    for readings in SampleReader(Recording(vehicle_path('straight_car_fast_left')),
                                 network).readings():
        for record in pipeline.feed(readings):
            if isinstance(record, Track) and not record.ended:
                found[record.ambiguous] = record
    return found


def test_sensor_transforms_equal_the_poses_in_the_network():
    network = line_network(4)
    messages = sensor_transform_dicts(network, 7)
    assert tuple(m['child_frame_id'] for m in messages) == network.names
    for j, m in enumerate(messages):
        t, q = m['transform']['translation'], m['transform']['rotation']
        np.testing.assert_allclose([t['x'], t['y'], t['z']], network.positions[j])
        np.testing.assert_allclose(rotation_from_quaternion([q[a] for a in 'xyzw']),
                                   network.R_ws[j], atol=1e-12)
        assert m['header'] == {'stamp': {'sec': 0, 'nanosec': 7}, 'frame_id': 'map'}


def test_a_track_transform_equals_its_pose(tracks):
    track = tracks[False]
    (message,) = track_transform_dict(track, 'map', 'target')['transforms']
    pose = pose_message_dict(track, 'map')['pose']['pose']
    assert message['transform'] == {'translation': pose['position'],
                                    'rotation': pose['orientation']}
    assert message['child_frame_id'] == 'target'
    assert track_transform_dict(tracks[True], 'map', 'target') is None


def test_a_detection_has_the_probability_of_each_kind(tracks):
    for track in tracks.values():
        ((detection,),) = [detections_3d_dict(track, 'map')['detections']]
        scores = {r['hypothesis']['class_id']: r['hypothesis']['score']
                  for r in detection['results']}
        assert sum(scores.values()) == pytest.approx(1.0)
        assert scores[track.kind] == pytest.approx(track.kind_weight)
        assert list(scores.values()) == sorted(scores.values(), reverse=True)
        assert detection['bbox']['size']['x'] == track.length and detection['id'] == '1'
        pose = pose_message_dict(track, 'map')['pose']
        assert all(r['pose'] == pose for r in detection['results'])
    without_uncertainty = dataclasses.replace(track, topic_uncertainty=None)
    for unpublished in (without_uncertainty, dataclasses.replace(track, ended=True)):
        assert detections_3d_dict(unpublished, 'map')['detections'] == []


def test_a_detection_of_a_magnet_has_the_class_magnet():
    from mag_tracking.pipeline import settings_for
    from mag_tracking.stages.track.manager import TrackManager
    network, frames, _ = magnet_frames(3)
    stage = TrackManager(network, settings_for('magnet').track)
    track = [t for f in frames for t in stage.feed(f)][-1]
    ((detection,),) = [detections_3d_dict(track, 'map')['detections']]
    assert [r['hypothesis']['class_id'] for r in detection['results']] == ['magnet']


def test_markers_have_a_namespace_per_kind_and_an_id_per_track(tracks):
    track = dataclasses.replace(tracks[False], id=7)
    markers = track_markers(track, 'map')['markers']
    assert tuple(m['ns'] for m in markers) == TRACK_NAMESPACES
    assert all(m['id'] == 7 and m['lifetime'] == {'sec': LIFETIME_S} for m in markers)
    deletions = delete_markers(track, 'map')['markers']
    assert [(m['ns'], m['id'], m['action']) for m in deletions] \
        == [(k, 7, 2) for k in TRACK_NAMESPACES]
    label = markers[2]['text']
    assert label.startswith(f'7 {track.kind} ') and label.endswith(' m/s')
    assert track_markers(tracks[True], 'map')['markers'][2]['text'].endswith(' m/s?')


def test_the_ellipsoid_matches_the_covariance_of_pose_topics(tracks):
    """The ellipsoid of an ambiguous track covers all hypotheses."""
    for ambiguous, track in tracks.items():
        scale = track_markers(track, 'map')['markers'][0]['scale']
        published = track.topic_uncertainty.covariance[:3, :3]
        np.testing.assert_allclose(
            sorted(scale.values()), 2 * 2.5003 * np.sqrt(np.linalg.eigvalsh(published)), rtol=1e-9)
        track_diameter = 2 * 2.5003 * np.sqrt(np.linalg.eigvalsh(track.covariance[:3, :3])[-1])
        assert (max(scale.values()) > 1.001 * track_diameter) <= ambiguous


def test_sensor_markers_are_at_the_sensor_positions():
    network = line_network(4, spacing=0.02)
    network = dataclasses.replace(network, positions=network.positions * 0.01)
    markers = sensor_markers(network)['markers']
    assert [m['ns'] for m in markers] == list(SENSOR_NAMESPACES) * 4
    assert [m['text'] for m in markers[1::2]] == list(network.names)
    for j, m in enumerate(markers[::2]):
        p = m['pose']['position']
        np.testing.assert_allclose([p['x'], p['y'], p['z']], network.positions[j])
        # On a board, a marker is smaller than the sensor spacing.
        assert 0.0 < m['scale']['x'] < 0.0002
