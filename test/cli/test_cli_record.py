"""`mag-tracking record` and `repair` in this process: output, options and errors."""

import argparse
import os
import re
import signal
import threading
import time

import pytest
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import MagneticField

from mag_tracking.apps.record import Selection
from mag_tracking.cli import nodes, recordings
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.messages.types import decode
from mag_tracking.network.sensor_network import absolute
from mag_tracking.nodes import record_node
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.recorder import Recorder
from support.bundled import NETWORK_FILE
from support.recorded_topics import FIELDS, IMUS

pytestmark = [pytest.mark.alone, pytest.mark.timeout(600)]
NS = 10**9


def arguments_of(*arguments):
    """Parse a command line."""
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers()
    nodes.add(commands)
    recordings.add(commands)
    return parser.parse_args([str(a) for a in arguments])


def test_record_prints_progress_and_a_summary(tmp_path, monkeypatch, capsys):
    """SIGINT ends the recording; the QoS of a best-effort driver is recorded."""
    monkeypatch.setattr(record_node, 'PROGRESS_INTERVAL_S', 0.2)
    # Polls are rare, so that the last messages are fetched by the final poll.
    monkeypatch.setattr(record_node, 'POLL_INTERVAL_S', 0.5)
    stopped, logged = threading.Event(), []
    monkeypatch.setattr(record_node, 'log', lambda text, log=record_node.log: (
        logged.append(text), log(text)))

    def n_recorded():
        numbers = [re.search(r' s: (\d+) messages', text) for text in logged]
        return max((int(number[1]) for number in numbers if number), default=0)

    def drive():
        while not rclpy.ok() and not stopped.wait(0.01):
            pass
        node = Node('driver')
        publisher = node.create_publisher(MagneticField, FIELDS[0], QoSProfile(
            depth=10, reliability=ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE))
        while not stopped.wait(0.01) and (
                sum(' s: ' in text for text in logged) < 3 or n_recorded() <= 50
                or len(list((tmp_path / 'a').glob('*.mcap'))) < 2):
            publisher.publish(MagneticField())
        last = MagneticField()
        last.header.frame_id = 'last'
        publisher.publish(last)
        time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)
        node.destroy_node()
    driver = threading.Thread(target=drive)
    driver.start()
    args = arguments_of('record', '--network', NETWORK_FILE, '--out', tmp_path / 'a',
                        '--split-s', 1)
    try:
        assert args.run_command(args) == 0
    finally:
        stopped.set()
        driver.join()
    out, err = capsys.readouterr()
    n = Recording(tmp_path / 'a').message_counts[FIELDS[0]]
    assert len(list((tmp_path / 'a').glob('*.mcap'))) > 1
    assert n > 50 and f'  {FIELDS[0]}  {n}\n  warning: ' in out and FIELDS[1] in out
    assert decode(list(Recording(tmp_path / 'a').messages())[-1]).header.frame_id == 'last'
    assert err.count(' s: ') >= 3 and ' messages, 0.0 MB' in err
    with Reader(tmp_path / 'a') as reader:
        assert reader.connections[0].ext.offered_qos_profiles[0].reliability.name == 'BEST_EFFORT'


def test_options_select_topics_and_limit_files(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(record_node, 'run', lambda selection, *options: calls.append(
        (selection.resolved(absolute), *options)) or 7)
    common = ('record', '--network', NETWORK_FILE, '--out', tmp_path)
    for options in ((), ('--topics', '/a', '/b', '--split-mb', 0.5, '--split-s', 60, '--all'),
                    ('--results',)):
        args = arguments_of(*common, *options)
        assert args.run_command(args) == 7
    assert calls == [(selection.resolved(absolute), tmp_path, size, seconds * NS, [])
                     for selection, size, seconds in (
        (Selection(FIELDS, IMUS), 10**9, 3600),
        (Selection(FIELDS, IMUS, ('/a', '/b'), all_topics=True), 500_000, 60),
        (Selection(FIELDS, IMUS, results=True), 10**9, 3600))]


@pytest.mark.parametrize(('options', 'message'), [
    (('--split-mb', '0'), '--split-mb: expected 0.1 or more, got 0'),
    (('--split-mb', 'nan'), '--split-mb: expected 0.1 or more, got nan'),
    (('--split-s', 'inf'), '--split-s: expected 1 or more, got inf'),
    (('--split-s', '-5'), '--split-s: expected 1 or more, got -5'),
    (('--topics', '/a', 'i mu'), "--topics: 'i mu'")])
def test_invalid_options_are_named(tmp_path, options, message):
    args = arguments_of('record', '--network', NETWORK_FILE, '--out', tmp_path / 'a', *options)
    with pytest.raises(SettingsError, match=message):
        args.run_command(args)
    assert not (tmp_path / 'a').exists()


def test_an_existing_recording_is_not_overwritten(tmp_path):
    (tmp_path / 'a_0.mcap').write_text('theirs')
    args = arguments_of('record', '--network', NETWORK_FILE, '--out', tmp_path)
    with pytest.raises(OutputError, match='already'):
        args.run_command(args)
    assert not rclpy.ok() and [p.name for p in tmp_path.iterdir()] == ['a_0.mcap']


def test_repair_writes_the_index(tmp_path, capsys):
    with Recorder(tmp_path / 'a') as recorder:
        recorder.add_topic('/x', 'std_msgs/msg/Header')
        recorder.write('/x', b'\0\1\0\0', 1)
    file = tmp_path / 'a' / 'a_0.mcap'
    file.write_bytes(file.read_bytes()[:-20])
    args = arguments_of('repair', tmp_path / 'a')
    assert args.run_command(args) == 0
    assert capsys.readouterr().out == (f'a_0.mcap: index written; messages: 1\n{tmp_path / "a"}: '
                                       'files repaired: 1\n')
    assert Recording(tmp_path / 'a').message_counts == {'/x': 1}
