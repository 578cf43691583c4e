"""Live page of a recording: same tracks as a replay, and tolerance of wrong timestamps."""

import json
import time

import numpy as np
import pytest

from mag_tracking.apps.track import track
from mag_tracking.apps.view import view
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.web.live_scene import LiveScene
from support.bundled import NETWORK_FILE, QUICK, vehicle_path
from support.samples import field_dict

NAME = 'straight_small_left'
YEARS_NS = 10 * 365 * 86400 * 1_000_000_000


class StoringScene(LiveScene):
    """Live scene that stores its tracks, smoothed tracks and notes."""

    def __init__(self, network):
        super().__init__('road', network)
        self.tracks, self.notes, self.smoothed = [], [], []

    def add_track(self, track):
        super().add_track(track)
        self.tracks.append(track)

    def add_smoothed(self, track_id, points):
        super().add_smoothed(track_id, points)
        self.smoothed.append(points)

    def set_health(self, notes, tables):
        super().set_health(notes, tables)
        self.notes = [note.text for note in notes]


def view_recording(path, network, rate):
    """View a recording at `rate` times real time; return (scene, duration [s])."""
    scene = StoringScene(network)
    start_s = time.monotonic()
    view(Recording(path), network, settings_for('vehicle', QUICK), scene, rate, lambda: False)
    return scene, time.monotonic() - start_s


def test_tracks_equal_a_replay(road_network):
    scene, seconds = view_recording(vehicle_path(NAME), road_network, 4.0)
    expected = track(vehicle_path(NAME), NETWORK_FILE, settings=QUICK)
    poses = [t for t in scene.tracks if not t.ended]
    np.testing.assert_array_equal([p.stamp_ns for p in poses], expected.poses['stamp_ns'])
    np.testing.assert_allclose([p.position for p in poses], expected.poses['position'], atol=1e-9)
    assert scene.tracks[-1].ended and len(scene.smoothed) == 1
    assert ['end' in note for note in scene.notes] == [True]
    recording = Recording(vehicle_path(NAME))
    assert seconds > 0.9 * (recording.end_ns - recording.start_ns) / 1e9 / 4.0
    assert json.loads(scene.snapshot()[-1])['tables'][0]['rows'][0][1] == 'ready'


def test_an_hour_without_messages_is_skipped(road_network, tmp_path):
    path = tmp_path / 'gap.mcap'
    rewrite(path, road_network, lambda k, ns: ns + (3600 * 1_000_000_000 if k > 900 else 0),
            lambda k, ns: ns)
    assert view_recording(path, road_network, 20.0)[1] < 60.0


def rewrite(path, network, log_time_of, stamp_of):
    """Copy the recording with new log times and new sensor timestamps.

    Both functions map (index of a message, original time [ns]) to the new time [ns].
    """
    reader = SampleReader(Recording(vehicle_path(NAME)), network)
    with RecordingWriter(path) as writer:
        for k, (readings, log_ns) in enumerate(reader.readings_as_received()):
            name = readings.names[0]
            writer.write(f'/{name}/imu/mag', MAGNETIC_FIELD, field_dict(
                stamp_of(k, int(readings.stamp_ns[0])), name, readings.field[0]),
                log_time_of(k, log_ns))


@pytest.mark.parametrize('wrong_ns', [YEARS_NS, -YEARS_NS])
def test_a_wrong_timestamp_does_not_stop_the_view(road_network, tmp_path, wrong_ns):
    path = tmp_path / 'wrong.mcap'
    rewrite(path, road_network, lambda k, ns: ns,
            lambda k, ns: ns + (wrong_ns if k == 900 else 0))
    scene, seconds = view_recording(path, road_network, 20.0)
    assert seconds < 60.0
    assert 'end of' in scene.notes[0] and len(scene.notes) > 1
    assert len([t for t in scene.tracks if not t.ended]) > 20


def test_the_view_ends_when_stopped(road_network):
    polls = []

    def stopped():
        polls.append(None)
        return len(polls) > 50

    scene = StoringScene(road_network)
    view(Recording(vehicle_path(NAME)), road_network, settings_for('vehicle', QUICK), scene, 1.0,
         stopped)
    assert not any('end of' in note for note in scene.notes)
