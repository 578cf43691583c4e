"""Messages of a live scene: restarts, late records, bounded memory and invalid numbers."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.records import FieldFrame
from mag_tracking.web.live_scene import HISTORY_S, MAX_POSES, LiveScene
from support.live_records import NS, delayed_records, feed, poses


class Viewer:
    """State of a page that receives messages; `tracks` is {key: times of the poses [s]}."""

    def __init__(self):
        self.tracks, self.ended, self.scenes = {}, set(), 0

    def receive(self, messages):
        for message in map(json.loads, messages):
            if message['type'] == 'scene':
                self.tracks, self.ended, self.scenes = {}, set(), self.scenes + 1
            for track in message.get('tracks', message.get('scene', {}).get('tracks', ())):
                times = np.frombuffer(base64.b64decode(track['columns']['t']['f8']))
                self.tracks.setdefault(track['key'], []).extend(times.tolist())
                if track['ended']:
                    self.ended.add(track['key'])
        return self


def follow(scene, records):
    """Feed `records` to `scene`; return a `Viewer` that receives an update every seven records."""
    viewer = Viewer().receive(scene.updates())
    for k in range(0, len(records), 7):
        feed(scene, records[k:k + 7])
        viewer.receive(scene.updates())
    # The first message after the first record is the scene; rows follow it.
    return viewer.receive(scene.updates())


def test_early_and_late_viewers_have_the_same_tracks(scene, records):
    viewer = follow(scene, records)
    late = Viewer().receive(scene.snapshot())
    assert late.tracks == viewer.tracks and late.ended == viewer.ended == {1}
    assert len(viewer.tracks[1]) == len(poses(records))
    assert all(np.diff(viewer.tracks[1]) > 0.0)


@pytest.mark.parametrize('seconds', [40.0, 4000.0])
def test_track_1_of_a_restarted_tracker_is_a_new_track(scene, records, seconds):
    viewer = follow(scene, records)
    viewer.receive(scene.updates())
    for part in (delayed_records(records, seconds),):
        feed(scene, part)
        viewer.receive(scene.updates())
    assert len(viewer.tracks) == 2
    assert [len(times) for times in viewer.tracks.values()] == [len(poses(records))] * 2
    assert viewer.scenes <= 2


def test_a_track_after_a_killed_tracker_is_a_new_track(scene, records):
    """Track 1 has no closing record; another track 1 begins minutes later."""
    viewer = follow(scene, records[:-1])
    feed(scene, delayed_records(records, 300.0))
    viewer.receive(scene.updates())
    assert len(viewer.tracks) == 2


def test_a_late_record_of_a_track_does_not_clear_the_page(scene, records):
    """A closing record has the timestamp of the last pose, which may be seconds old."""
    viewer = follow(scene, [r for r in records if isinstance(r, FieldFrame) or not r.ended])
    last = [r for r in records if isinstance(r, FieldFrame)][-1]
    scene.add_frame(replace(last, stamp_ns=last.stamp_ns + 8 * NS))
    scenes = viewer.scenes
    scene.add_track(replace(poses(records)[-1], ended=True))
    viewer.receive(scene.updates())
    assert viewer.scenes == scenes and viewer.ended == {1}


def test_a_looped_bag_clears_the_page(scene, records):
    viewer = follow(scene, records)
    scenes = viewer.scenes
    viewer.receive(updates_after(scene, records[:60]))
    assert viewer.scenes == scenes + 1
    assert sum(map(len, viewer.tracks.values())) == len(poses(records[:60]))


def updates_after(scene, records):
    feed(scene, records)
    return [*scene.updates(), *scene.updates()]


def test_old_tracks_and_excess_poses_are_removed(scene, records):
    template, pose = [r for r in records if isinstance(r, FieldFrame)][-1], poses(records)[30]
    stamp = template.stamp_ns
    for track_id in range(1, 120):
        for _ in range(400):
            stamp += NS // 20
            scene.add_track(replace(pose, id=track_id, stamp_ns=stamp))
        scene.add_track(replace(pose, id=track_id, stamp_ns=stamp, ended=True))
        scene.add_smoothed(track_id, np.zeros((400, 3)))
        scene.add_frame(replace(template, stamp_ns=stamp))
    late = Viewer()
    scene.updates()
    rows = scene.updates()
    late.receive([*scene.snapshot()])
    n_kept = sum(map(len, late.tracks.values()))
    assert n_kept <= MAX_POSES
    first = min(times[-1] for times in late.tracks.values())
    last = max(times[-1] for times in late.tracks.values())
    assert last - first <= HISTORY_S
    # Without a viewer, the smoothed poses of removed tracks are also removed.
    assert sum(len(json.loads(m).get('smoothed', ())) for m in rows) == len(late.tracks)


def frame_times(messages):
    return [f['t'] for m in map(json.loads, messages) for f in m.get('frames', ())]


def test_each_frame_is_sent_once_and_a_new_viewer_gets_the_latest(scene, records):
    frames = [r for r in records if isinstance(r, FieldFrame)][:40]
    scene.add_frame(frames[0])
    scene.updates()
    times = frame_times(scene.updates())
    for k in range(1, 40, 3):
        feed(scene, frames[k:k + 3])
        times += frame_times(scene.updates())
    expected = [(f.stamp_ns - frames[0].stamp_ns) / NS for f in frames]
    assert times == pytest.approx(expected)
    scene.add_frame(replace(frames[-1], stamp_ns=frames[-1].stamp_ns + NS))
    assert frame_times(scene.snapshot()) == pytest.approx(expected)


def test_nan_values_give_valid_json(scene, records):
    feed(scene, [replace(r, moment=np.full(3, np.nan), nis=np.nan)
                 if not isinstance(r, FieldFrame) else r for r in records])
    messages = [*scene.updates(), *scene.snapshot()]
    assert messages

    def refuse(text):
        raise AssertionError(f'{text} is not JSON')

    for message in messages:
        json.loads(message, parse_constant=refuse)


def test_fields_are_those_of_the_sensors_near_the_target(records, road_network):
    """Fields of eight sensors are sent while a target moves from the first sensor to the last."""
    n = 20

    class Road:
        names = tuple(f'mag_{j}' for j in range(n))
        positions = np.column_stack([5.0 * np.arange(n), np.zeros((n, 2))])
        frame = 'map'

        def __len__(self):
            return n

    scene, pose = LiveScene('road', Road()), poses(records)[30]
    sent = []
    for k in range(400):
        near = np.abs(np.arange(n) - k / 20.0) < 1.5
        field = np.where(near[:, None], 1e-6, 1e-12) * np.ones((n, 3))
        frame = FieldFrame(pose.stamp_ns + k * NS // 10, field, np.zeros((n, 3, 3)),
                           np.ones(n, dtype=int), np.zeros(n))
        scene.add_frame(frame)
        scene.add_track(replace(pose, stamp_ns=frame.stamp_ns, predicted=field,
                                nis_by_sensor=np.zeros(n)))
        for message in map(json.loads, scene.updates()):
            sent += [{f['sensor'] for f in t['fields']} for t in message.get('tracks', ())]
    assert {0, 1} <= sent[1] and {18, 19} <= sent[-1]
    assert {len(sensors) for sensors in sent} == {8}
