"""Track the vehicle in a bundled recording over real ROS topics.

A car turns at a junction between two magnetometers. The replay node publishes the recording;
calibration, detection and tracker nodes process it. This program subscribes to their topics, prints
the poses as they arrive, and draws the track.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from mag_tracking_msgs.msg import HypothesisArray, NetworkFrame, SmoothedTrack, TrackArray
from rclpy.node import Node

from mag_tracking.analysis.track_errors import interpolate_truth, pass_errors
from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.errors import MagTrackingError, OutputError
from mag_tracking.files import replace_text
from mag_tracking.messages.network import frame_of
from mag_tracking.messages.schema import stamp_ns
from mag_tracking.network.file import read_network
from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.runner import pose_line, run
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from mag_tracking.pipeline import settings_for
from mag_tracking.report.figures import field_figure, map_figure, weights_figure
from mag_tracking.report.page import Page, report_html
from mag_tracking.report.page_scene import (
    facts_of,
    path_entry,
    scene_of,
    strongest_sensors,
    track_entry,
)

ROOT = Path(__file__).resolve().parents[1]
RECORDING = ROOT / 'test' / 'data' / 'vehicles' / 'junction_left_turns_to_rear.mcap'


class Spectator(Node):
    """ROS node that subscribes to the topics of the other nodes, and stores their messages."""

    def __init__(self, network):
        super().__init__('spectator')
        self.network = network
        self.logs, self.truth, self.smoothed = {}, [], {}
        self._frames, self._hypotheses = {}, {}
        self.create_subscription(NetworkFrame, '/network_frame', self._on_frame, STREAM_QOS)
        self.create_subscription(HypothesisArray, '/tracker_node/hypotheses', self._on_hypotheses,
                                 STREAM_QOS)
        self.create_subscription(TrackArray, '/tracker_node/tracks', self._on_tracks, STREAM_QOS)
        self.create_subscription(SmoothedTrack, '/tracker_node/smoothed', self._on_smoothed,
                                 RESULT_QOS)
        self.create_subscription(PoseStamped, '/ground_truth/vehicle_00/pose', self._on_truth,
                                 STREAM_QOS)

    def _on_frame(self, message):
        frame = frame_of(message, self.network)
        self._frames[frame.stamp_ns] = frame

    def _on_hypotheses(self, message):
        self._hypotheses[stamp_ns(message.header.stamp)] = message

    def _on_smoothed(self, message):
        """Store the smoothed path of a track that has ended."""
        positions = [p.pose.pose.position for p in message.poses]
        self.smoothed[message.track_id] = np.array([[p.x, p.y, p.z] for p in positions])

    def _on_truth(self, message):
        p, q = message.pose.position, message.pose.orientation
        self.truth.append((stamp_ns(message.header.stamp), p.x, p.y, p.z, q.x, q.y, q.z, q.w))

    def truth_arrays(self):
        """Ground truth: timestamps (n,), positions (n, 3), quaternions xyzw (n, 4)."""
        rows = sorted(self.truth)
        return (np.array([r[0] for r in rows], dtype=np.int64), np.array([r[1:4] for r in rows]),
                np.array([r[4:] for r in rows]))

    def _on_tracks(self, message):
        for m in message.tracks:
            track = track_of(m)
            if track.ended:
                print(f'track {track.id} has ended', flush=True)
                self.logs.setdefault(track.id, TrackLog(track.id)).ended = True
                continue
            print(pose_line(track), flush=True)
            frame = self._frames.get(track.stamp_ns)
            hypotheses = self._hypotheses.get(track.stamp_ns)
            if frame is None or hypotheses is None:
                continue  # Frame published before this node connected: the pose is only printed.
            self.logs.setdefault(track.id, TrackLog(track.id)).add(track_of(m, hypotheses), frame)


def draw(spectator, out):
    """Write figures and a summary of each track, print the summaries; return the figure paths."""
    truth = spectator.truth_arrays()
    paths, network = [], spectator.network
    for log in spectator.logs.values():
        if not log.stamp_ns:
            continue
        for name, figure in (
                ('map', map_figure(log, network, interpolate_truth(truth, log.stamp_ns),
                                   spectator.smoothed.get(log.id))),
                ('weights', weights_figure(log)), ('field', field_figure(log, network))):
            paths.append(out / f'{name}_track_{log.id}.png')
            figure.savefig(paths[-1], dpi=110)
        summary = {**log.summary(), 'truth': pass_errors(log, truth, network.centre)}
        (out / f'track_{log.id}.json').write_text(json.dumps(summary, indent=1) + '\n')
        print(f'\ntrack {log.id}: a {summary["kind"]} from {summary["arrival"]}, '
              f'{summary["speed"]:.1f} m/s, {summary["moment_size"]:.0f} A m²; '
              f'error at the closest point of approach {summary["truth"]["closest"]:.2f} m, '
              f'RMS error within 5 m {summary["truth"]["rms"] or float("nan"):.2f} m')
    return paths


def write_page(spectator, out):
    """Write all tracks as one HTML page; return its path."""
    logs = [log for log in spectator.logs.values() if log.stamp_ns]
    begin_ns = min(log.stamp_ns[0] for log in logs)
    tracks = []
    for log in logs:
        entry = track_entry(log, begin_ns, strongest_sensors(log))
        entry['facts'] = facts_of(log.summary())
        if log.id in spectator.smoothed:
            entry['smoothed'] = path_entry(spectator.smoothed[log.id])
        entry['truth'] = path_entry(interpolate_truth(spectator.truth_arrays(), log.stamp_ns))
        tracks.append(entry)
    scene = scene_of(spectator.network, begin_ns, max(log.stamp_ns[-1] for log in logs), tracks)
    path = out / 'report.html'
    replace_text(path, report_html(Page('A car turns at a junction', scene=scene)))
    return path


def main(argv=None):
    """Run the demo; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', type=Path, default=Path('out/demo'))
    parser.add_argument('--rate', type=float, default=3.0,
                        help='replay speed relative to real time (default: 3)')
    args = parser.parse_args(argv)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot write to {args.out}: {error.strerror}') from error
    network_file = ROOT / 'config' / 'network.yaml'
    spectators = []

    def spectator():
        spectators.append(Spectator(read_network(network_file)))
        return spectators[-1]

    print(f'Replaying {RECORDING.name} at {args.rate:g} times real time through the calibration, '
          'detection and tracker nodes.\nIn the first seconds, no vehicle is near the sensors '
          'and the background is estimated.\n', flush=True)
    status = run(network_file, settings_for('vehicle'), RECORDING, args.rate,
                 observers=[spectator])
    paths = draw(spectators[0], args.out)
    if not paths:
        print('no track was received; see the output of the nodes above', file=sys.stderr)
        return 1
    print('pictures:', *paths, sep='\n  ')
    print(f'report for the browser: {write_page(spectators[0], args.out)}')
    return status


if __name__ == '__main__':
    try:
        sys.exit(main())
    except MagTrackingError as problem:
        sys.exit(f'demo: {problem}')
