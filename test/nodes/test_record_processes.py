"""`mag-tracking record` as a process: complete recordings, and small losses after a kill."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import MagneticField
from std_srvs.srv import Trigger

from mag_tracking.apps.replay import replay
from mag_tracking.messages.types import decode
from mag_tracking.nodes import record_node
from mag_tracking.nodes.stage_node import STREAM_QOS
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.repair import repair
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import MAX_S, call, start, stop
from support.recorded_topics import FIELDS, IMUS
from support.shared_memory import orphaned_segments, segments_of

pytestmark = pytest.mark.timeout(600)
NS = 10**9
COMMAND = ('import argparse, sys; from mag_tracking.cli import nodes; '
           'from mag_tracking.nodes import record_node; record_node.PROGRESS_INTERVAL_S = 0.2; '
           'p = argparse.ArgumentParser(); nodes.add(p.add_subparsers()); '
           'a = p.parse_args(); sys.exit(a.run_command(a))')


def recording_process(out, *options):
    """Start `mag-tracking record` as a process and wait until it reports the start."""
    process = subprocess.Popen(
        [sys.executable, '-u', '-c', COMMAND, 'record', '--network', NETWORK_FILE, '--out', out,
         *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    line = process.stdout.readline()
    assert f'recording to {out}' in line, line + process.stdout.read()
    return process


def await_messages(process, n):
    """Wait until a recording process reports `n` messages, or no new message for ten seconds."""
    before, lines = None, 0
    for line in process.stdout:
        match = re.search(r' s: (\d+) messages', line)
        if match:
            lines = lines + 1 if match[1] == before else 0
            before = match[1]
            if int(before) >= n or lines > 50:
                return


def contents(path, topics):
    """{topic: [decoded message as a string]}; the padding of the serialised bytes is undefined."""
    out = {t: [] for t in topics}
    for m in Recording(path).messages(topics):
        out[m.topic].append(repr(decode(m)))
    return out


def poses(folder):
    """poses.csv as an array."""
    with open(folder / 'poses.csv', newline='') as stream:
        rows = list(csv.DictReader(stream))
    return np.array([[float(r[c]) for c in ('stamp_ns', 'x', 'y', 'vx', 'mx', 'weight')]
                     for r in rows])


def test_a_recorded_replay_equals_the_original(ros, tmp_path, road_network):
    """Messages and tracks are equal; rosbags also reads all messages. SIGTERM ends the recorder."""
    before = set(os.listdir('/dev/shm'))
    original, out = vehicle_path('straight_car_right'), tmp_path / 'night'
    process = recording_process(out)
    player = start('replay_node', '-p', f'recording:={original}', '-p', 'rate:=5.0',
                   '-p', 'paused:=true', '-p', 'wait_for_subscribers:=300.0')
    expected = {t: n for t, n in Recording(original).message_counts.items() if '/imu/' in t}
    assert set(expected) == {*FIELDS, *IMUS}
    try:
        assert any('4 of 4 topics' in line for line in process.stdout)
        assert call(ros, Trigger, '/replay_node/resume', Trigger.Request()).success
        assert 'messages played' in player.stdout.readline()
        await_messages(process, sum(expected.values()))
        segments = segments_of(process.pid) - before
    finally:
        stop([player])
        process.send_signal(signal.SIGTERM)
        output = process.communicate(timeout=MAX_S)[0]
    assert process.returncode == 0 and 'warning' not in output, output
    for topic, n in expected.items():
        assert f'  {topic}  {n}\n' in output, output
    assert f'{out}: {sum(expected.values())} messages' in output
    expected_contents, recorded_contents = contents(original, expected), contents(out, expected)
    assert expected_contents == recorded_contents and set(Recording(out).types) == set(expected)
    with AnyReader([out], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        counts = Counter(c.topic for c, _, raw in reader.messages()
                         if reader.deserialize(raw, c.msgtype))
    assert counts == expected
    with open(out / 'night_0.mcap', 'rb') as stream:
        times = [m.log_time for _, _, m in make_reader(stream).iter_messages(log_time_order=False)]
    # Messages are also ordered across topics, except within one poll.
    assert np.mean(np.diff(times) >= 0) > 0.9
    long_wait = settings_for('vehicle', {'align.max_wait_s': 5.0})
    for path in (original, out):
        replay(Recording(path), road_network, long_wait, tmp_path / f'of_{path.stem}')
    np.testing.assert_allclose(*(poses(tmp_path / f'of_{path.stem}') for path in (original, out)),
                               rtol=1e-9, atol=1e-12)
    assert segments and not orphaned_segments(segments)


def test_a_kill_of_the_command_loses_less_than_a_second(ros, tmp_path):
    node, spin_until = ros
    before = set(os.listdir('/dev/shm'))
    send_times = []
    publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM_QOS)

    def publish():
        message = MagneticField()
        message.header.stamp.nanosec = len(send_times)
        send_times.append(time.time_ns())
        publisher.publish(message)
    process = recording_process(tmp_path / 'a')
    try:
        node.create_timer(0.005, publish)
        # Some chunks have been written, and the next chunk is being filled.
        assert spin_until(lambda: sum(
            p.stat().st_size for p in (tmp_path / 'a').glob('*.mcap')) > 6000)
        n = len(send_times)
        spin_until(lambda: len(send_times) > n + 150)
    finally:
        segments = segments_of(process.pid)
        process.kill()
        kill_time = time.time_ns()
        process.communicate()
        # A killed process leaves its shared memory; segments in `before` belong to this process.
        for name in segments - before & set(os.listdir('/dev/shm')):
            os.unlink(f'/dev/shm/{name}')
    messages = list(Recording(tmp_path / 'a').messages())
    numbers = [decode(m).header.stamp.nanosec for m in messages]
    assert numbers == sorted(set(numbers)) and len(numbers) > 100
    print(f'lost: {(kill_time - send_times[numbers[-1]]) / NS:.2f} s')
    assert kill_time - send_times[numbers[-1]] < NS
    # Log times are arrival times, not poll times.
    delays = [m.log_time_ns - send_times[k] for m, k in zip(messages, numbers, strict=True)]
    assert min(delays) > 0 and np.median(delays) < record_node.POLL_INTERVAL_S * NS / 4
    assert repair(tmp_path / 'a', report=lambda _: None) == 1
    with Reader(tmp_path / 'a') as reader:
        assert reader.message_count == len(numbers)
