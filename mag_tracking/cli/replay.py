"""mag-tracking replay."""

import argparse
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from mag_tracking.apps.replay import replay, write_figures, write_trajectories
from mag_tracking.apps.replay_notes import notes_of
from mag_tracking.apps.replay_report import write_report
from mag_tracking.cli.options import (
    Commands,
    add_command,
    add_recorded_network,
    distinct_names,
    recorded_network,
)
from mag_tracking.cli.tracking_options import add_settings, settings_of
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.recording.reader import Recording
from mag_tracking.report.page import WARNING
from mag_tracking.report.rerun_file import RERUN_FILE, check_rerun, write_rerun
from mag_tracking.stages.track.doubts import MEANINGS

_REPLAY = '''
Reads the magnetic fields of the network's topics, learns each sensor's
background from the target-free beginning, detects, and tracks with a bank of
filters. No ROS has to run: the nodes use the very same code.

Writes to DIR:
  poses.csv        the published pose, one row a frame
  poses_smoothed.csv  the same by what came before and after, when a track has ended
  detections.csv   onsets and releases
  disturbances.csv fields that no target explains
  hypotheses.csv   every member of the bank, every frame
  summary.json     counts, rejected samples by cause, the tracks
  tracks.mcap      poses and tracks as ROS messages (with metadata.yaml)
  report.html      all of it to look at in a browser: map, time slider, curves, tables
  *_track_N.png    the map, the weights, measured against predicted field
With several recordings, each gets a folder of its own in DIR. Results of an earlier run are
replaced, its figures removed; other files in the folder stay.

examples:
  mag-tracking replay junction.mcap --network config/network.yaml --out out
  mag-tracking replay magnet/ --network magnet/network.yaml --target magnet --out out
  mag-tracking replay night.mcap --network site.yaml --params mine.yaml --out out

A parameter file holds only what differs from the defaults (config/default.yaml
has them all, with their meaning):
  track:
    vehicle:
      arrival_names: ['east', 'west']
      arrival_headings_deg: [180.0, 0.0]
'''


TRUTH_METRICS = {
    'rms': ('horizontal RMS error within 5 m', ' m'),
    'closest': ('horizontal error at the closest point', ' m'),
    'closest_distance': ('distance there', ' m'),
    'position_mean': ('mean position error', ' m'),
    'position_max': ('largest position error', ' m'),
    'axis_median_deg': ('median angle of the axis', ' deg'),
    'anees': ('squared error over what the covariance says, an axis (ANEES)', ''),
    'error_over_bound': ('error over the path bound', '')}
"""{key of a track's `truth` in summary.json: (meaning, unit)}."""


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'replay', _replay, _REPLAY)
    p.add_argument('recordings', nargs='+', type=Path, metavar='RECORDING',
                   help='an .mcap, .db3 or .bag file, or a rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder for the results')
    add_settings(p)
    p.add_argument('--truth', metavar='TOPIC|FILE.csv', help='true poses to compare with: a topic '
                   'with PoseStamped, PoseWithCovarianceStamped or Odometry, or a table with '
                   'the columns t [s] or stamp_ns, x, y, z [m], qx, qy, qz, qw (default: the '
                   'topics below /ground_truth)')
    p.add_argument('--tum', action='store_true',
                   help='write each track as track_N.tum, too (time x y z qx qy qz qw)')
    p.add_argument('--rerun', action='store_true',
                   help='write tracks.rrd for the Rerun viewer, too (needs rerun-sdk)')
    p.add_argument('--no-figures', action='store_true', help='leave the pictures out')


def _replay(args: argparse.Namespace) -> int:
    """mag-tracking replay."""
    network, settings = recorded_network(args), settings_of(args)
    names = distinct_names(args.recordings)
    if args.rerun:
        check_rerun()
    with recorded_signals(signal.SIGINT) as seen:
        for path, name in zip(args.recordings, names, strict=True):
            out = args.out / name if len(args.recordings) > 1 else args.out
            _replay_one(path, network, settings, out, seen, args)
            if seen:
                print(f'interrupted; what was done is in {out}')
                return 130
    return 0


def _replay_one(path: Path, network: SensorNetwork, settings: Settings, out: Path,
                seen: Sequence[int], args: argparse.Namespace) -> None:
    """Replay one recording into one folder; what was done stays when it is interrupted."""
    recording = Recording(path)
    with tqdm(total=recording.size, unit='B', unit_scale=True, desc=path.name,
              disable=None) as bar:
        run = replay(recording, network, settings, out, bar.update, lambda: bool(seen), tqdm.write,
                     args.truth)
    _print_summary(path, run.summary, bool(run.truth))
    if args.tum:
        write_trajectories(run, out)
    if args.rerun:
        write_rerun(out / RERUN_FILE, network, run.logs, run.smoothed)
    write_report(run, network, out)
    if not args.no_figures:
        write_figures(run, network, out, stopped=lambda: bool(seen))
    if not seen:
        print(f'results in {out}')


def _print_summary(path: Path, summary: dict[str, Any], has_truth: bool) -> None:
    """The run in a few lines."""
    print(f'{path.name}: {summary["counts"]["align"].get("frames", 0)} frames, '
          f'{summary["counts"]["detect"].get("onsets", 0)} detections, '
          f'{len(summary["tracks"])} tracks')
    for note in notes_of(summary):
        print(f'  {"warning: " if note.level == WARNING else ""}{note.text}')
    for t in summary['tracks']:
        _print_track(t)
        if has_truth and 'truth' not in t:
            print('    no true pose at the time of this track')


def _print_track(t: dict[str, Any]) -> None:
    """A track in a few lines."""
    print(f'  track {t["id"]}: {t["poses"]} poses'
          + (f', from {t["arrival"]} ({t["arrival_weights"][t["arrival"]]:.0%})'
             if t['arrival'] else '')
          + (f', a {t["kind"]} ({t["kind_weight"]:.0%})' if t['kind'] else '')
          + f', {t["speed"]:.2f} m/s, {t["moment_size"]:.3g} A m^2, {t["verdict"]}')
    for doubt, n in t['doubts'].items():
        print(f'    ambiguous in {n} of {t["poses"]} poses: {MEANINGS[doubt]} ({doubt})')
    delay = t.get('delay', {})
    if 'speed' in delay:
        print(f'    by the delay between sensors: {delay["speed"]:.2f} '
              f'({delay["speed_sd"]:.2f}) m/s, {delay["heading_deg"]:.0f} deg'
              + (', along the line of the sensors' if delay['heading_sd_deg'] is None else ''))
    if delay.get('contradicts'):
        print('    warning: track and delay contradict each other; believe neither (a clock, '
              'a position in the network file, a turn, frames that are too long)')
    for name, m in t['mounting'].items():
        if m['suspicious']:
            print(f'    warning: {name} fits best if turned by '
                  f'{max(m["angles_deg"], key=abs):+.0f} degrees about one axis: its '
                  'orientation in the network file is wrong, or the target is not as modelled')
    truth = t.get('truth', {})
    for name, (text, unit) in TRUTH_METRICS.items():
        if isinstance(truth.get(name), float):
            print(f'    against {truth["name"]}: {text} {truth[name]:.4g}{unit}')
