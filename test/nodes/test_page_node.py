"""The live page of running nodes: over the middleware, in a browser, with the topic's values."""

import re
import subprocess
import sys
import time

import numpy as np
from mag_tracking_msgs.msg import TrackArray

from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.stage_node import STREAM
from support.browser import Page as Opened
from support.browser import browser, needs_browser
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import LONGEST_S, environment

COMMAND = [sys.executable, '-m', 'mag_tracking.cli']
RECORDING = vehicle_path('straight_car_right')


def command(*arguments):
    return subprocess.Popen([*COMMAND, *map(str, arguments)], stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True, env=environment())


def address(process):
    """The address that the command prints."""
    for line in process.stdout:
        found = re.search(r'live page: (\S+)', line)
        if found:
            return found[1]
    raise AssertionError(f'no address before its end with {process.wait()}')


def ended(process):
    process.terminate()
    process.communicate(timeout=LONGEST_S)
    return process.returncode


@needs_browser
def test_the_page_of_running_nodes_has_the_values_of_the_topic(ros):
    """The page is opened before the nodes are started, and says what it waits for."""
    node, spin_until = ros
    heard = []
    node.create_subscription(TrackArray, '/tracker_node/tracks', heard.append, STREAM)
    watch = command('watch', '--port', 0)
    try:
        with browser() as chromium:
            page = Opened(chromium, address(watch))
            page.wait('document.getElementById("notes").textContent.includes('
                      '"no publisher on /tracker_node/tracks")')
            run = command('run', '--network', NETWORK_FILE, '--recording', RECORDING)
            assert spin_until(lambda: any(t.status == t.ENDED for m in heard for t in m.tracks))
            page.wait('magTracking.scene?.tracks.length && magTracking.scene?.tracks[0]?.ended')
            poses = [track_of(t) for m in heard for t in m.tracks if t.status == t.ACTIVE]
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
            assert page.complaints == []
            run.communicate(timeout=LONGEST_S)
    finally:
        assert ended(watch) == 0


def test_run_serves_the_page_and_frees_the_port():
    run = command('run', '--network', NETWORK_FILE, '--web', 0)
    url = address(run)
    assert re.fullmatch(r'http://127\.0\.0\.1:\d+/', url)
    assert ended(run) == 0
    port = int(url.rstrip('/').rpartition(':')[2])
    end = time.monotonic() + LONGEST_S
    again = command('watch', '--port', port)
    assert address(again) == url and time.monotonic() < end
    # The port is taken now: the command says so before any node is up.
    refused = command('run', '--network', NETWORK_FILE, '--web', port)
    output = refused.communicate(timeout=LONGEST_S)[0]
    assert refused.returncode == 1
    assert f'port {port}: Address already in use' in output
    assert ended(again) == 0
