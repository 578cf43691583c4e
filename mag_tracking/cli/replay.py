"""Command `mag-tracking replay`."""

import argparse
import signal
from collections import Counter
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
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.report.page import WARNING
from mag_tracking.results.rerun_file import RERUN_FILE, check_rerun, write_rerun
from mag_tracking.stages.track.doubts import MEANINGS

_REPLAY_HELP = '''
Reads the magnetic fields on the topics of the network, learns the background of each sensor
from a quiet interval, detects targets and tracks them with a bank of filters. ROS does not
have to run; the ROS nodes use the same code.

files written to DIR:
  poses.csv           published poses, one row per track and frame
  poses_smoothed.csv  smoothed poses of the tracks that have ended
  detections.csv      onset and release of each detection
  disturbances.csv    fields that no target explains
  hypotheses.csv      all hypotheses of the filter bank, one row per hypothesis and frame
  summary.json        counts, rejected samples by cause, tracks
  tracks.mcap         poses and tracks as ROS messages (with metadata.yaml)
  report.html         interactive report: map, time slider, curves, tables
  *_track_N.png       figures: map, weights, measured and predicted field

With several recordings, each has its own folder in DIR. Results of a previous run are replaced and
its figures are removed; other files in the folder are kept.

examples:
  mag-tracking replay junction.mcap --network config/network.yaml --out out
  mag-tracking replay magnet/ --network magnet/network.yaml --target magnet --out out
  mag-tracking replay night.mcap --network site.yaml --params mine.yaml --out out

The file of --params contains only the settings to override; config/default.yaml describes those of
users, the reference all. Example:
  track:
    vehicle:
      arrival_names: ['east', 'west']
      arrival_headings_deg: [180.0, 0.0]
'''


TRUTH_METRICS = {
    'rms': ('horizontal RMS error within 5 m of the centre of the sensors', ' m'),
    'closest': ('horizontal error at the closest point of approach', ' m'),
    'closest_distance': ('distance at the closest point of approach', ' m'),
    'position_mean': ('mean position error', ' m'),
    'position_max': ('maximum position error', ' m'),
    'axis_median_deg': ('median angular error of the axis', ' deg'),
    'anees': ('average NEES per axis (1 if consistent)', ''),
    'error_over_bound': ('ratio of the error to the Cramer-Rao bound of the path', '')}
"""Description and unit of each error measure, by its key in a track's `truth` in summary.json."""


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'replay', _replay, _REPLAY_HELP)
    p.add_argument('recordings', nargs='+', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='output folder')
    add_settings(p)
    p.add_argument('--truth', metavar='TOPIC|FILE.csv', help='ground truth: a topic '
                   'with PoseStamped, PoseWithCovarianceStamped or Odometry, or a CSV table with '
                   'the columns t [s] or stamp_ns, x, y, z [m], and qx, qy, qz, qw or the '
                   'direction mx, my, mz of a magnet (default: all topics below /ground_truth)')
    p.add_argument('--tum', action='store_true',
                   help='also write each track as track_N.tum (time x y z qx qy qz qw)')
    p.add_argument('--rerun', action='store_true',
                   help='also write tracks.rrd for the Rerun viewer (needs rerun-sdk)')
    p.add_argument('--no-figures', action='store_true', help='do not draw figures')


def _replay(args: argparse.Namespace) -> int:
    """Run `mag-tracking replay`."""
    network = recorded_network(args)
    settings = settings_of(args, network)
    names = distinct_names(args.recordings)
    if args.rerun:
        check_rerun()
    with recorded_signals(signal.SIGINT) as signals:
        for path, name in zip(args.recordings, names, strict=True):
            out = args.out / name if len(args.recordings) > 1 else args.out
            _replay_one(path, network, settings, out, signals, args)
            if signals:
                print(f'interrupted; partial results in {out}')
                return 130
    return 0


def _replay_one(path: Path, network: SensorNetwork, settings: Settings, out: Path,
                signals: Sequence[int], args: argparse.Namespace) -> None:
    """Replay one recording into one folder; an interrupted run leaves partial results."""
    recording = Recording(path)
    with tqdm(total=recording.size, unit='B', unit_scale=True, desc=path.name,
              disable=None) as bar:
        run = replay(recording, network, settings, out, bar.update, lambda: bool(signals),
                     tqdm.write, args.truth)
    _print_summary(path, run.summary, bool(run.truth))
    if args.tum:
        write_trajectories(run, out)
    if args.rerun:
        write_rerun(out / RERUN_FILE, network, run.logs, run.smoothed)
    write_report(run, network, out)
    if not args.no_figures:
        write_figures(run, network, out, stopped=lambda: bool(signals))
    if not signals:
        print(f'{_overview(path, run.summary)}; results in {out}')


def _print_summary(path: Path, summary: dict[str, Any], has_truth: bool) -> None:
    """Print counts, notes and tracks of a run."""
    counts = summary['counts']
    print(f'{path.name}: {quantity(counts["align"].get("frames", 0), "frame")}, '
          f'{quantity(counts["detect"].get("onsets", 0), "detection")}, '
          f'{quantity(len(summary["tracks"]), "track")}')
    for note in notes_of(summary):
        print(f'  {"warning: " if note.level == WARNING else ""}{note.text}')
    for t in summary['tracks']:
        _print_track(t)
        if has_truth and 'truth' not in t:
            print('    no ground truth during this track')


def _overview(path: Path, summary: dict[str, Any]) -> str:
    """Format the name of the recording and its numbers of tracks, in total and by verdict."""
    verdicts = Counter(t['verdict'] for t in summary['tracks'])
    counts = ', '.join(f'{n} {verdict}' for verdict, n in verdicts.most_common())
    return (f'{path.name}: {quantity(len(summary["tracks"]), "track")}'
            + (f' ({counts})' if counts else ''))


def _print_track(t: dict[str, Any]) -> None:
    """Print a track: overview, doubts, velocity from delays between sensors, mounting, errors."""
    print(f'  track {t["id"]}: {quantity(t["poses"], "pose")}'
          + (f', from {t["arrival"]} ({t["arrival_weights"][t["arrival"]]:.0%})'
             if t['arrival'] else '')
          + (f', {t["kind"]} ({t["kind_weight"]:.0%})' if t['kind'] else '')
          + f', {t["speed"]:.2f} m/s, {t["moment_size"]:.3g} A m^2, {t["verdict"]}')
    for doubt, n in t['doubts'].items():
        print(f'    ambiguous in {n} of {quantity(t["poses"], "pose")}: {MEANINGS[doubt]} '
              f'({doubt})')
    delay = t.get('delay', {})
    if 'speed' in delay:
        print(f'    velocity from the delay between sensors: {delay["speed"]:.2f} '
              f'({delay["speed_sd"]:.2f}) m/s, heading {delay["heading_deg"]:.0f} deg'
              + (' (assumed along the line of the sensors)' if delay['heading_sd_deg'] is None
                 else ''))
    if delay.get('contradicts'):
        print('    warning: the velocities of the track and from the delay contradict each other; '
              'rely on neither. Check clock offsets, positions in the network file, the frame '
              'period, and whether the target turned')
    for name, m in t['mounting'].items():
        if m['suspicious']:
            print(f'    warning: {name} fits best if rotated by '
                  f'{max(m["angles_deg"], key=abs):+.0f} degrees about one axis: its '
                  'orientation in the network file is wrong, or the target differs from the '
                  'model')
    truth = t.get('truth', {})
    for name, (description, unit) in TRUTH_METRICS.items():
        if isinstance(truth.get(name), float):
            print(f'    against {truth["name"]}: {description}: {truth[name]:.4g}{unit}')
