"""Command `mag-tracking replay`."""

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.apps.replay import Run, replay, write_figures, write_trajectories
from mag_tracking.apps.replay_report import notes_of, write_report
from mag_tracking.apps.traffic import check_vehicles
from mag_tracking.cli import options
from mag_tracking.cli.fit import HEADER, ORDERS, Fits, time_of, vehicle_row
from mag_tracking.cli.tables import Events, Passages
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.files import output_folder
from mag_tracking.geometry import speed_of
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import STAGES, Pipeline, Settings
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.report.page import WARNING
from mag_tracking.results.track_files import RERUN_FILE, check_rerun, write_rerun
from mag_tracking.run import RecordingSource, Sink, output_error, progress_bar, run
from mag_tracking.stages.track.doubts import MEANINGS

_REPLAY_HELP = '''
Reads the magnetic fields on the topics of the network, learns the background of each sensor
from a quiet interval, detects targets and tracks them with a bank of filters. ROS does not
have to run; the ROS nodes use the same code.

tables, selected by --tables NAME,NAME,... (default: poses), computed in one run:
  poses     the tracks of all targets:
              poses.csv           published poses, one row per track and frame
              poses_smoothed.csv  smoothed poses of the tracks that have ended
              detections.csv      onset and release of each detection
              disturbances.csv    fields that no target explains
              hypotheses.csv      all hypotheses of the filter bank
              summary.json        counts, rejected samples by cause, tracks
              tracks.mcap         poses and tracks as ROS messages (with metadata.yaml)
              report.html         interactive report: map, time slider, curves, tables
              *_track_N.png       figures: map, weights, measured and predicted field
  passages  the vehicles that cross a line (default: perpendicular to the x axis, through the centre
            of the network; the setting traffic.lines defines other lines), counted when their
            tracks have ended; ambiguous passages are marked:
              passages.csv        one row per vehicle: time, direction, speed, class, ...
              intervals.csv       counts and mean speeds per interval, direction and class
            The same tables are written as Parquet if pyarrow is installed. With --fleet, enrolled
            vehicles are recognised by their hard and soft iron, at any heading if they were
            enrolled at headings at least 45 degrees apart, otherwise only at the enrolled heading.
  events    the passes at each sensor, without tracking; one sensor with one axis is sufficient. The
            stay of a parked vehicle is one event. Distance and speed are not observable:
              events.csv          onset, release, peak, energy, closest point of approach, direction
              signatures.csv      shape of the field
  fits      each pass, fitted as a whole (see mag-tracking fit): fits.csv, fits.json

With several recordings, poses and events have a folder in DIR for each recording. Results of a
previous run are replaced and its figures are removed; other files in the folder are kept.

examples:
  mag-tracking replay junction.mcap --network config/network.yaml --out out
  mag-tracking replay junction.mcap --network config/network.yaml --live
  mag-tracking replay magnet/ --network magnet/network.yaml --target magnet --out out
  mag-tracking replay monday.mcap tuesday.mcap --network site.yaml --tables passages --out week
  mag-tracking replay out.mcap back.mcap --network site.yaml --tables passages \\
      --fleet fleet.json --enrol 'van 3'

The file of --params contains only the settings to override; config/default.yaml describes those of
users, the reference all. Example:
  track:
    vehicle:
      arrival_names: ['east', 'west']
      arrival_headings_deg: [180.0, 0.0]
'''


Table: TypeAlias = Passages | Events | Fits
POSES = 'poses'
TABLES: dict[str, type[Table]] = {'passages': Passages, 'events': Events, 'fits': Fits}
"""Tables of --tables besides `POSES`."""
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


def add(commands: options.Commands) -> None:
    """Register the command."""
    p = options.add_command(commands, 'replay', _replay, _REPLAY_HELP)
    p.add_argument('recordings', nargs='+', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    options.add_recorded_network(p)
    p.add_argument('--out', type=Path, metavar='DIR', help='output folder; passages and events '
                   'are only printed without it')
    options.add_settings(p)
    p.add_argument('--tables', type=_tables, default=[POSES], metavar='NAME,NAME,...',
                   help=f'tables to compute: {", ".join((POSES, *TABLES))} (default: {POSES})')
    options.add_verbose(p)
    poses = p.add_argument_group('table poses')
    poses.add_argument('--truth', metavar='TOPIC|FILE.csv', help='ground truth: a topic '
                       'with PoseStamped, PoseWithCovarianceStamped or Odometry, or a CSV table '
                       'with the columns t [s] or stamp_ns, x, y, z [m], and qx, qy, qz, qw or the '
                       'direction mx, my, mz of a magnet (default: all topics below /ground_truth)')
    poses.add_argument('--tum', action='store_true',
                       help='also write each track as track_N.tum (time x y z qx qy qz qw)')
    poses.add_argument('--rerun', action='store_true',
                       help='also write tracks.rrd for the Rerun viewer (needs rerun-sdk)')
    poses.add_argument('--no-figures', action='store_true', help='do not draw figures')
    passages = p.add_argument_group('table passages')
    passages.add_argument('--fleet', type=Path, metavar='FILE',
                          help='fleet file with the enrolled vehicles (.json)')
    passages.add_argument('--enrol', metavar='NAME',
                          help='add the vehicle of each recording, which must be the only one, to '
                          'the fleet file under this name')
    live = p.add_argument_group('live page')
    live.add_argument('--live', action='store_true', help='track the recording in real time on a '
                      'live page instead of writing files; Ctrl-C ends the command')
    live.add_argument('--rate', type=float, default=1.0, help='playback speed (default: 1)')
    options.add_page(live)
    p.set_defaults(orders=ORDERS, cpa_range=None)


def _tables(text: str) -> list[str]:
    names = list(dict.fromkeys(text.split(',')))
    if not {*names} <= {POSES, *TABLES}:
        raise argparse.ArgumentTypeError(f'expected names from {", ".join((POSES, *TABLES))}, '
                                         f'separated by commas; got {text!r}')
    return names


def _replay(args: argparse.Namespace) -> int:
    network = options.recorded_network(args)
    settings = options.settings_of(args, network)
    _check(args, settings)
    if args.live:
        return _show(args, network, settings)
    names = options.distinct_names(args.recordings)
    sources = [RecordingSource(Recording(path), network) for path in args.recordings]
    folders = [args.out / name if args.out and len(names) > 1 else args.out for name in names]
    _check_folders(args, sources, folders)
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals, ExitStack() as stack:
        def stopped() -> bool:
            return bool(signals)

        tables = [TABLES[name](args, network, stopped, stack)
                  for name in args.tables if name != POSES]
        is_complete = True
        for source, out in zip(sources, folders, strict=True):
            is_complete &= _replay_one(source, network, settings, out, tables, stopped, args)
            if signals:
                break
        if args.out is not None:
            print(f'{"interrupted; partial results" if signals else "results"} in {args.out}'
                  + ('' if is_complete else ' are incomplete'))
        elif signals:
            print('interrupted: the results cover only the part read so far')
    return 130 if signals else 0 if is_complete else 1


def _show(args: argparse.Namespace, network: SensorNetwork, settings: Settings) -> int:
    """Track a recording in real time on the live page until Ctrl-C; return the exit status."""
    # Imported here because only --live needs them.
    from mag_tracking.apps.view import view
    from mag_tracking.web.live_scene import LiveScene
    from mag_tracking.web.page_server import PageServer

    if not 0.0 < args.rate < float('inf'):
        raise SettingsError(f'--rate: expected a number above 0, got {args.rate:g}')
    path = args.recordings[0]
    recording, scene = Recording(path), LiveScene(path.name, network)
    scene.subtitle = f'{quantity(len(network), "sensor")}, frame {network.frame}'
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals, \
            PageServer(scene, args.host, args.port) as server:
        print(f'live page: {server.url}')
        view(recording, network, settings, scene, args.rate,
             lambda: bool(signals) or not server.is_serving)
        if not signals:
            print('end of the recording; the page remains available until Ctrl-C')
        while not signals and server.is_serving:
            time.sleep(0.1)
        return 0 if server.is_serving else 1


def _check(args: argparse.Namespace, settings: Settings) -> None:
    if args.live:
        if len(args.recordings) > 1 or args.tables != [POSES] or args.tum or args.rerun or any(
                v is not None for v in (args.out, args.truth, args.fleet, args.enrol)):
            raise SettingsError('--live shows one recording and writes no files: omit the other '
                                'recordings and the options of tables and files')
        return
    if args.out is None and {POSES, 'fits'} & {*args.tables}:
        raise SettingsError('add --out DIR for the results, or --live for a live page')
    if {'passages', 'fits'} & {*args.tables}:
        check_vehicles(settings)
    if 'passages' not in args.tables and (args.fleet, args.enrol) != (None, None):
        raise SettingsError('--fleet and --enrol require --tables passages')
    if POSES not in args.tables and (args.truth is not None or args.tum or args.rerun):
        raise SettingsError('--truth, --tum and --rerun require --tables poses')
    if args.rate != 1.0:
        raise SettingsError('--rate requires --live')
    if args.rerun:
        check_rerun()


def _check_folders(args: argparse.Namespace, sources: Iterable[RecordingSource],
                   folders: Iterable[Path | None]) -> None:
    """Create the output folder; raises OutputError if it is the folder of a recording."""
    if args.out is None:
        return
    shared = {args.out} if {'passages', 'fits'} & {*args.tables} else set()
    if any(source.recording.lies_in(folder) for source, own in zip(sources, folders, strict=True)
           for folder in (own, *shared) if folder is not None):
        raise OutputError(f'--out: {args.out} is the folder of the recording; choose another '
                          'output folder')
    output_folder(args.out)


def _replay_one(source: RecordingSource, network: SensorNetwork, settings: Settings,
                out: Path | None, tables: Sequence[Table], stopped: Callable[[], bool],
                args: argparse.Namespace) -> bool:
    """Compute the tables of one recording; return whether everything could be written."""
    sinks: list[Sink] = []

    def sinks_of(pipeline: Pipeline) -> list[Sink]:
        sinks.extend(table.sink(source.stem, pipeline) for table in tables)
        return sinks

    if POSES in args.tables and out is not None:
        with progress_bar(source) as bar:
            result = replay(source.recording, network, settings, out, bar.update, stopped,
                            tqdm.write, args.truth, sinks_of)
        report = result.report
        _print_summary(source.name, result, network, args.verbose)
        if not report.failures:
            _write(result, network, out, stopped, args)
    else:
        pipeline = Pipeline(network, settings,
                            max((table.upto for table in tables), key=STAGES.index))
        with progress_bar(source) as bar:
            report = run(source, pipeline, sinks_of(pipeline), bar.update, stopped)
        options.print_diagnoses(report.diagnoses)
    errors = [failure.error for failure in report.failures]
    for table, sink in zip(tables, sinks, strict=True):
        if report.has_failed(sink):
            continue
        try:
            table.finish(source.stem, report, out)
        except (OutputError, OSError) as error:
            errors.append(output_error(error, table))
    for reason in errors:
        print(f'mag-tracking: incomplete results: {reason}', file=sys.stderr)
    return not errors


def _write(result: Run, network: SensorNetwork, out: Path, stopped: Callable[[], bool],
           args: argparse.Namespace) -> None:
    if args.tum:
        write_trajectories(result, out)
    if args.rerun:
        write_rerun(out / RERUN_FILE, network, result.logs, result.smoothed)
    write_report(result, network, out)
    if not args.no_figures:
        write_figures(result, network, out, stopped)


def _print_summary(name: str, result: Run, network: SensorNetwork, verbose: bool) -> None:
    counts, tracks = result.summary['counts'], result.summary['tracks']
    verdicts = Counter(t['verdict'] for t in tracks)
    print(f'{name}: {quantity(counts["align"].get("frames", 0), "frame")}, '
          f'{quantity(counts["detect"].get("onsets", 0), "detection")}, '
          f'{quantity(len(tracks), "track")}' + (' (' + ', '.join(
              f'{n} {verdict}' for verdict, n in verdicts.most_common()) + ')' if tracks else ''))
    for note in notes_of(result.summary):
        print(f'  {"warning: " if note.level == WARNING else ""}{note.text}')
    if tracks:
        print(HEADER)
    for t in tracks:
        print(_row(t, result.logs[t['id']], network))
        if verbose:
            _print_details(t, bool(result.truth))
        _print_warnings(t)


def _row(t: dict[str, Any], log: TrackLog, network: SensorNetwork) -> str:
    """Format a track: time and distance at its closest pose, speed at the most certain one."""
    distances = np.linalg.norm(np.array(log.position) - network.centre, axis=1)
    closest, best = int(np.argmin(distances)), log.most_certain()
    return vehicle_row(
        f'track {t["id"]}', time_of(log.stamp_ns[closest]), t['kind'], t['arrival'],
        speed_of(log.velocity[best][:2], log.covariance[best][3:5, 3:5]),
        (float(distances[closest]), np.nan), t['verdict'])


def _print_details(t: dict[str, Any], has_truth: bool) -> None:
    print(f'    {quantity(t["poses"], "pose")}'
          + (f', from {t["arrival"]} ({t["arrival_weights"][t["arrival"]]:.0%})'
             if t['arrival'] else '')
          + (f', {t["kind"]} ({t["kind_weight"]:.0%})' if t['kind'] else '')
          + f', {t["speed"]:.2f} m/s, {t["moment_size"]:.3g} A m^2')
    for doubt, n in t['doubts'].items():
        print(f'    ambiguous in {n} of {quantity(t["poses"], "pose")}: {MEANINGS[doubt]} '
              f'({doubt})')
    delay = t.get('delay', {})
    if 'speed' in delay:
        print(f'    velocity from the delay between sensors: {delay["speed"]:.2f} '
              f'({delay["speed_sd"]:.2f}) m/s, heading {delay["heading_deg"]:.0f} deg'
              + (' (assumed along the line of the sensors)' if delay['heading_sd_deg'] is None
                 else ''))
    truth = t.get('truth', {})
    for name, (description, unit) in TRUTH_METRICS.items():
        if isinstance(truth.get(name), float):
            print(f'    against {truth["name"]}: {description}: {truth[name]:.4g}{unit}')
    if has_truth and not truth:
        print('    no ground truth during this track')


def _print_warnings(t: dict[str, Any]) -> None:
    if t.get('delay', {}).get('contradicts'):
        print('    warning: the velocities of the track and from the delay contradict each other; '
              'rely on neither. Check clock offsets, positions in the network file, the frame '
              'period, and whether the target turned')
    for name, m in t['mounting'].items():
        if m['suspicious']:
            print(f'    warning: {name} fits best if rotated by '
                  f'{max(m["angles_deg"], key=abs):+.0f} degrees about one axis: its '
                  'orientation in the network file is wrong, or the target differs from the '
                  'model')
