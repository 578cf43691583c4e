"""The command `mag-tracking`."""

import argparse
import signal
import sys
from pathlib import Path

from tqdm import tqdm

from mag_tracking.errors import MagTrackingError, OutputError
from mag_tracking.interrupts import noted_signals
from mag_tracking.io.bag import Recording
from mag_tracking.io.network_file import read_network
from mag_tracking.offline import replay, write_figures
from mag_tracking.pipeline import TARGET_DEFAULTS, settings_for
from mag_tracking.settings import read_parameter_file

_REPLAY = '''
Reads the magnetic fields of the network's topics, learns each sensor's
background from the target-free beginning, detects, and tracks with a bank of
filters. No ROS has to run: the nodes use the very same code.

Writes to DIR:
  poses.csv        the published pose, one row a frame
  poses_smoothed.csv  the same by what came before and after, when a track has ended
  detections.csv   onsets and releases
  hypotheses.csv   every member of the bank, every frame
  summary.json     counts, rejected samples by cause, the tracks
  tracks.mcap      poses and tracks as ROS messages (with metadata.yaml)
  *_track_N.png    the map, the weights, measured against predicted field
With several recordings, each gets a folder of its own in DIR.

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

_RUN = '''
Starts calibration, detection and tracker nodes in one process, and with a
RECORDING the replay node as well. Drivers publish sensor_msgs/MagneticField on
the topics of the network file. Ctrl-C ends it.

examples:
  mag-tracking run --network config/network.yaml
  mag-tracking run --network config/network.yaml --recording junction.mcap --rate 2
'''

_IMPORT = '''
Turns a table of magnet poses (a row a sensor and pose: id, timestamp [s],
Bx By Bz [uT, sensor frame], sensor_x..z [mm], sensor_ox..oz [rad], m_x..z [mm],
m_ox..oz [rad]) and the background per sensor [uT] into a recording and a
network.yaml.

example:
  mag-tracking import poses.csv --background background.csv --out magnet
'''


def _parser():
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='mag-tracking', description='Track magnetic targets with stationary magnetometers.')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')

    def command(name, short, text):
        return commands.add_parser(name, help=short, description=short, epilog=text,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)

    p = command('replay', 'Track what is in recordings, offline.', _REPLAY)
    p.add_argument('recordings', nargs='+', type=Path, metavar='RECORDING',
                   help='an .mcap file or a rosbag2 folder')
    p.add_argument('--network', required=True, type=Path, metavar='FILE',
                   help='positions and orientations of the sensors (network.yaml)')
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder for the results')
    p.add_argument('--params', type=Path, metavar='FILE', help='settings that differ')
    p.add_argument('--target', choices=list(TARGET_DEFAULTS), default='vehicle',
                   help='what moves (default: vehicle)')
    p.add_argument('--no-figures', action='store_true', help='leave the pictures out')

    p = command('run', 'Run the nodes in one process (needs ROS 2).', _RUN)
    p.add_argument('--network', required=True, type=Path, metavar='FILE')
    p.add_argument('--target', choices=list(TARGET_DEFAULTS), default='vehicle')
    p.add_argument('--params', type=Path, metavar='FILE')
    p.add_argument('--recording', type=Path, metavar='RECORDING', help='replay this, too')
    p.add_argument('--rate', type=float, default=1.0, help='speed of the replay (default: 1)')
    p.add_argument('--loop', action='store_true', help='begin again at the end')

    p = command('info', 'Tell what is in a recording.', '')
    p.add_argument('recording', type=Path, metavar='RECORDING')
    p.add_argument('--network', type=Path, metavar='FILE', help='compare with its topics')

    p = command('import', 'Turn a table of magnet poses into a recording.', _IMPORT)
    p.add_argument('table', type=Path, metavar='POSES.csv')
    p.add_argument('--background', required=True, type=Path, metavar='FILE.csv')
    p.add_argument('--out', required=True, type=Path, metavar='DIR')
    p.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                   help='noise of one reading (default: 1e-6)')
    return parser


def _settings(args):
    """Settings of the command line's target and parameter file."""
    changes = read_parameter_file(args.params) if args.params else {}
    return settings_for(args.target, changes)


def _replay(args):
    """mag-tracking replay."""
    network, settings = read_network(args.network), _settings(args)
    names = [path.resolve().stem for path in args.recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise OutputError(f'two recordings are named {twice[0]}: their results would overwrite '
                          'each other; replay them one by one')
    with noted_signals(signal.SIGINT) as seen:
        for path, name in zip(args.recordings, names, strict=True):
            out = args.out / name if len(args.recordings) > 1 else args.out
            _replay_one(path, network, settings, out, seen, not args.no_figures)
            if seen:
                print(f'interrupted; what was done is in {out}')
                return 130
    return 0


def _replay_one(path, network, settings, out, seen, figures):
    """Replay one recording into one folder; what was done stays when it is interrupted."""
    recording = Recording(path)
    with tqdm(total=recording.size, unit='B', unit_scale=True, desc=path.name,
              disable=None) as bar:
        run = replay(recording, network, settings, out, bar.update, lambda: bool(seen))
    _print_summary(path, run.summary)
    if figures:
        write_figures(run, network, out, stopped=lambda: bool(seen))
    if not seen:
        print(f'results in {out}')


def _print_summary(path, summary):
    """The run in a few lines."""
    print(f'{path.name}: {summary["counts"]["align"].get("frames", 0)} frames, '
          f'{summary["counts"]["detect"].get("onsets", 0)} detections, '
          f'{len(summary["tracks"])} tracks')
    for topic in summary['missing_topics']:
        print(f'  warning: nothing on {topic}')
    if not summary['counts']['detect'].get('onsets', 0):
        print(f'  nothing was detected with the settings for a {summary["target"]}')
    for what, n in {**summary['rejected'], **summary['lost']}.items():
        print(f'  warning: {what}: {n}')
    stuck = [name for name, s in summary['sensors'].items() if s['stuck']]
    if stuck:
        print(f'  warning: {", ".join(stuck)}: an axis does not vary (a stuck sensor, or one with '
              'coarse steps: give it a noise_std in the network file)')
    waiting = [name for name, s in summary['sensors'].items() if not s['ready'] and not s['stuck']]
    if waiting:
        print(f'  warning: no background was learnt for {", ".join(waiting)}: the recording needs '
              'a target-free beginning, or the network file a background and a noise_std')
    too_long = summary['counts']['track'].get('tracks too long to smooth', 0)
    if too_long:
        print(f'  warning: {too_long} tracks were too long to smooth (track.smooth_longest_s, or '
              'too many frames for so many sensors)')
    for t in summary['tracks']:
        print(f'  track {t["id"]}: {t["poses"]} poses'
              + (f', from {t["arrival"]} ({t["arrival_weights"][t["arrival"]]:.0%})'
                 if t['arrival'] else '')
              + (f', a {t["kind"]} ({t["kind_weight"]:.0%})' if t['kind'] else '')
              + f', {t["speed"]:.2f} m/s, {t["moment_size"]:.3g} A m^2, {t["verdict"]}')
        for name, m in t['mounting'].items():
            if m['suspicious']:
                print(f'    warning: {name} fits best if turned by '
                      f'{max(m["angles_deg"], key=abs):+.0f} degrees about one axis: its '
                      'orientation in the network file is wrong, or the target is not as modelled')
        for name, value in t.get('truth', {}).items():
            if isinstance(value, float):
                print(f'    against truth: {name} {value:.4g}')


def _run(args):
    """mag-tracking run."""
    # Only this command needs ROS.
    from mag_tracking.nodes.runner import run

    settings = _settings(args)
    read_network(args.network)
    if args.recording:
        Recording(args.recording)
    return run(args.network, settings, args.recording, args.rate, args.loop)


def _info(args):
    """mag-tracking info."""
    recording = Recording(args.recording)
    if not recording.message_counts:
        for message in recording.messages():
            recording.message_counts[message.topic] += 1
    print(f'{recording.path}: {recording.size / 1e6:.2f} MB, '
          f'{sum(recording.message_counts.values())} messages')
    if recording.start_ns is not None:
        print(f'  {(recording.end_ns - recording.start_ns) / 1e9:.2f} s')
    for topic in sorted(recording.types):
        print(f'  {topic}  {recording.types[topic]}  {recording.message_counts[topic]}')
    for what, n in recording.losses.items():
        print(f'  warning: {what}: {n}')
    if args.network:
        network = read_network(args.network)
        for name, topic in zip(network.names, network.topics, strict=True):
            state = 'there' if topic in recording.types else 'MISSING'
            print(f'  sensor {name}: {topic} is {state}')
    return 0


def _import(args):
    """mag-tracking import."""
    # Only this command needs it.
    from mag_tracking.io.importers import import_pose_table

    recording, network, n = import_pose_table(args.table, args.background, args.out,
                                              args.noise_std)
    print(f'{n} readings in {recording}, the network in {network}')
    return 0


def main(argv=None):
    """Run the command; returns its exit status (1 for an error that a message explains)."""
    args = _parser().parse_args(argv)
    command = {'replay': _replay, 'run': _run, 'info': _info, 'import': _import}[args.command]
    try:
        return command(args)
    except (MagTrackingError, OSError) as error:
        # An OSError here is a full disk or a lost drive; its text names the file.
        print(f'mag-tracking: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('mag-tracking: interrupted', file=sys.stderr)
        return 130


if __name__ == '__main__':
    sys.exit(main())
