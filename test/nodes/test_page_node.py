"""Live page of running nodes, over the middleware and in a browser."""

import io
import json
import re
import subprocess
import sys
import time
import urllib.error
import urllib.request
from array import array

import numpy as np
import pytest
from mag_tracking_msgs.msg import NetworkFrame, SmoothedTrack, TrackArray
from rclpy.duration import Duration
from visualization_msgs.msg import MarkerArray
from websockets.sync.client import connect

from mag_tracking.cli import main
from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import track_dict
from mag_tracking.messages.standard import sensor_markers
from mag_tracking.network.file import read_network
from mag_tracking.nodes.convert import to_message, track_of
from mag_tracking.nodes.runner import TrackPrinter
from mag_tracking.nodes.stage_node import LATCHED_QOS, RESULT_QOS, STREAM_QOS
from support.browser import Page as Opened
from support.browser import browser, needs_browser
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import MAX_S, environment
from support.track_records import track_pose

COMMAND = [sys.executable, '-m', 'mag_tracking.cli']
RECORDING = vehicle_path('straight_car_right')
LONG_WAIT_ARGUMENTS = ('--ros-args', '-p', 'align.max_wait_s:=5.0')
"""At a high playback rate, readings arrive later (in recording time) than the default wait."""


def command(*arguments):
    return subprocess.Popen([*COMMAND, *map(str, arguments)], stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True, env=environment())


def address(process):
    """Address of the page, as printed by the command."""
    for line in process.stdout:
        match = re.search(r'live page: (\S+)', line)
        if match:
            return match[1]
    raise AssertionError(f'the command ended with {process.wait()} and printed no address')


def terminate(process):
    process.terminate()
    process.communicate(timeout=MAX_S)
    return process.returncode


@needs_browser
def test_the_page_of_running_nodes_shows_the_values_of_the_topic(ros):
    """The page is opened before the nodes are started and names the missing topic."""
    node, spin_until = ros
    received = []
    node.create_subscription(TrackArray, '/tracker_node/tracks', received.append, STREAM_QOS)
    watch = command('ros', 'watch', '--port', 0)
    try:
        with browser() as chromium:
            page = Opened(chromium, address(watch))
            page.wait('document.getElementById("notes").textContent.includes('
                      '"no publisher on /tracker_node/tracks")')
            run = command('run', '--network', NETWORK_FILE, '--recording', RECORDING,
                          '--rate', 3, *LONG_WAIT_ARGUMENTS)
            assert spin_until(lambda: any(t.status == t.ENDED for m in received for t in m.tracks))
            page.wait('magTracking.scene?.tracks.length && magTracking.scene?.tracks[0]?.ended')
            poses = [track_of(t) for m in received for t in m.tracks if t.status == t.ACTIVE]
            columns = 'magTracking.scene.tracks[0].columns'
            n = page.value(f'{columns}.t.length')
            begin_ns = int(page.value('magTracking.scene.begin_ns'))
            stamps = np.array(page.value(f'Array.from({columns}.t)')) * 1e9 + begin_ns
            by_stamp = {p.stamp_ns: p for p in poses}
            assert n == len(poses)
            for k, stamp in enumerate(stamps):
                p = by_stamp[min(by_stamp, key=lambda s, stamp=stamp: abs(s - stamp))]
                assert page.value(f'[{columns}.x[{k}], {columns}.y[{k}]]') \
                    == p.position[:2].tolist()
            names = page.value('Object.keys(magTracking.scene.tracks[0].arrivals)')
            assert poses[-1].arrival in names and len(names) > 1
            measured = page.value('magTracking.scene.tracks[0].fields.map('
                                  'f => f.measured[1].filter(v => Number.isFinite(v)).length)')
            assert min(measured) > 0.9 * n
            page.wait('magTracking.scene?.tracks[0]?.smoothed')
            page.wait('document.getElementById("tables").textContent.includes("tracker_node")')
            assert page.page_errors == []
            run.communicate(timeout=MAX_S)
    finally:
        assert terminate(watch) == 0


def messages_of(url, until, seconds=MAX_S):
    """Yield the messages that a page sends to a viewer, until `until` is true for one of them."""
    with connect(url.replace('http', 'ws') + 'stream', max_size=None) as viewer:
        end = time.monotonic() + seconds
        while True:
            message = json.loads(viewer.recv(max(0.1, end - time.monotonic())))
            yield message
            if until(message):
                return


def test_a_renamed_tracker_is_found_and_may_be_restarted():
    """The second run starts again with track 1 and the times of the recording."""
    watch = command('ros', 'watch', '--port', 0)
    try:
        url = address(watch)
        for _ in range(2):
            run = command('run', '--network', NETWORK_FILE, '--recording', RECORDING,
                          '--rate', '4', *LONG_WAIT_ARGUMENTS,
                          '-r', 'tracker_node:__node:=follower')
            n = 0
            for message in messages_of(url, lambda m: any(
                    t['ended'] and t['doubts'] for t in m.get('tracks', ()))
                    or any(s for s in m.get('smoothed', ()))):
                for track in message.get('tracks', ()):
                    n += len(track['doubts'])
            assert n > 20
            run.communicate(timeout=MAX_S)
    finally:
        assert terminate(watch) == 0


def track_message(**changes):
    """TrackArray with one valid pose of a track at two sensors, with `changes` to the Track."""
    content = track_dict(track_pose(1.0, 0.0), 'map')
    content['arrivals'] = [{'arrival': 'left', 'weight': 1.0}]
    return to_message(TrackArray, {'tracks': [content | changes]})


MALFORMED_TRACKS = {
    'mounting_of_5': {'mounting': array('d', 5 * [0.0])},
    'covariance_of_10': {'mounting': array('d', 6 * [0.0]),
                         'mounting_covariance': array('d', 10 * [0.0])},
    'field_of_4': {'predicted_field': array('d', 4 * [0.0])},
    'innovations_of_3': {'innovation_by_sensor': array('d', 3 * [0.0])},
    'no_sensors': {'innovation_by_sensor': array('d'), 'predicted_field': array('d')},
    'infinite_velocity': {'velocity': {'x': float('inf'), 'y': 0.0, 'z': 0.0}},
    'nan_covariance': {'covariance': [float('nan')] * 36},
    'no_arrivals': {'arrivals': []}}


def publish_malformed_messages(node, spin_until):
    """Publish all malformed messages, a valid track, and then the sensor markers.

    The middleware keeps no order between topics, so tracks can precede the sensors.
    """
    def publish(cls, topic, message, qos):
        publisher = node.create_publisher(cls, topic, qos)
        assert spin_until(lambda: publisher.get_subscription_count())
        publisher.publish(message)
        return publisher

    publish(SmoothedTrack, '/tracker_node/smoothed', SmoothedTrack(track_id=1), RESULT_QOS)
    # Serialised bytes that are no message.
    publish(NetworkFrame, '/network_frame', b'\x00\x01\x00\x00' + b'\xff' * 300, RESULT_QOS)
    first, *others = MALFORMED_TRACKS.values()
    publisher = publish(TrackArray, '/tracker_node/tracks', track_message(**first), RESULT_QOS)
    for changes in others:
        publisher.publish(track_message(**changes))
    publisher.publish(track_message())
    assert publisher.wait_for_all_acked(Duration(seconds=MAX_S))
    markers = to_message(MarkerArray, sensor_markers(read_network(NETWORK_FILE)))
    publish(MarkerArray, '/tracker_node/sensor_markers', markers, LATCHED_QOS)


def test_malformed_messages_are_named_on_the_page(ros):
    """The page names each topic with invalid messages, and shows the valid track."""
    watch = command('ros', 'watch', '--port', 0)
    try:
        url = address(watch)
        publish_malformed_messages(*ros)
        *_, last = messages_of(url, lambda m: f'tracks: {len(MALFORMED_TRACKS)} invalid'
                               in json.dumps(m))
        notes = [note['text'] for note in last['notes']]
        for topic in ('smoothed', 'network_frame'):
            assert any(f'{topic}: 1 invalid' in text for text in notes)
        tracks = next(messages_of(url, lambda m: m['type'] == 'scene'))['scene']['tracks']
        assert len(tracks) == 1
    finally:
        assert terminate(watch) == 0


@pytest.mark.parametrize('changes', MALFORMED_TRACKS.values(), ids=MALFORMED_TRACKS)
def test_a_malformed_track_is_rejected(changes):
    with pytest.raises(RecordingError, match='Track 1'):
        track_of(track_message(**changes).tracks[0], n_sensors=2)


def test_a_malformed_track_does_not_end_the_printing_of_poses(ros):
    node, spin_until = ros
    out = io.StringIO()
    printer = TrackPrinter(out=out)
    publisher = node.create_publisher(TrackArray, 'tracker_node/tracks', RESULT_QOS)
    node.executor.add_node(printer)
    try:
        assert spin_until(lambda: publisher.get_subscription_count())
        publisher.publish(track_message(**MALFORMED_TRACKS['mounting_of_5']))
        publisher.publish(track_message())
        assert spin_until(lambda: out.getvalue())
        assert out.getvalue().count('\n') == 1
    finally:
        node.executor.remove_node(printer)
        printer.destroy_node()


def test_a_page_ends_with_the_command_that_started_it():
    """The page also ends if the command is killed."""
    run = command('run', '--network', NETWORK_FILE, '--web', 0)
    url = address(run)
    assert urllib.request.urlopen(url, timeout=MAX_S).status == 200
    run.kill()
    run.wait(MAX_S)
    end = time.monotonic() + MAX_S
    with pytest.raises(urllib.error.URLError):
        while time.monotonic() < end:
            urllib.request.urlopen(url, timeout=MAX_S).close()
            time.sleep(0.1)
    run.stdout.close()


def test_the_host_option_requires_the_page(capsys):
    assert main(['run', '--network', str(NETWORK_FILE), '--host', '0.0.0.0']) == 1
    assert 'add --web' in capsys.readouterr().err


def test_run_serves_the_page_and_frees_the_port():
    run = command('run', '--network', NETWORK_FILE, '--web', 0)
    url = address(run)
    assert re.fullmatch(r'http://127\.0\.0\.1:\d+/', url)
    assert terminate(run) == 0
    port = int(url.rstrip('/').rpartition(':')[2])
    end = time.monotonic() + MAX_S
    second_watch = command('ros', 'watch', '--port', port)
    assert address(second_watch) == url and time.monotonic() < end
    # The port is in use: the command reports it before it starts a node.
    second_run = command('run', '--network', NETWORK_FILE, '--web', port)
    output = second_run.communicate(timeout=MAX_S)[0]
    assert second_run.returncode == 1
    assert f'port {port}: ' in output
    assert terminate(second_watch) == 0
