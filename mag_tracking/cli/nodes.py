"""Commands `mag-tracking run` and `record`."""

import argparse
import math
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from mag_tracking.apps.record import Selection
from mag_tracking.cli import options
from mag_tracking.errors import SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import TOPIC_NAME_PATTERN
from mag_tracking.web import DEFAULT_PORT, LOOPBACK

_RUN_HELP = '''
Starts the calibration, detection and tracker nodes in one process, the replay node with
--recording, and the driver node with --drivers. The nodes call each other directly. All other
messages are published after the pose; intermediate results (calibrated fields, frames) are
published only if they have subscribers. Drivers of other packages must publish
sensor_msgs/MagneticField on the topics of the network file. Ctrl-C ends the nodes. ROS arguments
(--ros-args ...) come last.

examples:
  mag-tracking run --network config/network.yaml --drivers config/drivers.yaml
  mag-tracking run --network config/network.yaml --recording junction.mcap --rate 2
  mag-tracking run --network config/network.yaml --recording junction.mcap --loop --web
  mag-tracking run --network config/network.yaml --ros-args -r __ns:=/robot1
'''

_RECORD_HELP = '''
Records the magnetic fields on the topics of the network, unchanged, until Ctrl-C. The
sensor_msgs/Imu topics of the sensors (/mag_1/imu/data_raw next to /mag_1/imu/mag) are
also recorded. DIR becomes a rosbag2 recording: MCAP files and a metadata.yaml.
Messages that are lost in transport or dropped on a full disk are counted and reported;
recording resumes in a new file when the disk has space again. If the recorder is killed, less than
half a second is lost; `mag-tracking repair DIR` then rebuilds the index.

examples:
  mag-tracking record --network config/network.yaml --out night
  mag-tracking record --network site.yaml --out night --results --split-s 600
  mag-tracking record --network site.yaml --out night --topics /camera /gps/fix
  mag-tracking record --network site.yaml --out night --ros-args -r __ns:=/robot1
'''


def add(commands: options.Commands) -> None:
    """Register the commands."""
    p = options.add_command(commands, 'run', _run, _RUN_HELP)
    options.add_network(p)
    options.add_settings(p)
    p.add_argument('--recording', type=Path, metavar='RECORDING', help='replay this recording')
    p.add_argument('--drivers', type=Path, metavar='DRIVERS',
                   help='run a driver node with the devices of this drivers file')
    p.add_argument('--batches', action='store_true',
                   help='publish the readings of many sensors in one message (recommended for '
                   'dozens of sensors)')
    p.add_argument('--use-sim-time', action='store_true',
                   help='use the time on /clock, for example while a bag is played')
    p.add_argument('--rate', type=float, default=1.0,
                   help='playback speed of the recording (default: 1)')
    p.add_argument('--loop', action='store_true', help='repeat the recording')
    p.add_argument('--quiet', action='store_true', help='do not print the poses of tracks')
    p.add_argument('--web', type=int, nargs='?', const=DEFAULT_PORT, metavar='PORT',
                   help=f'serve a live page (default port: {DEFAULT_PORT})')
    options.add_page(p, port=False)
    p = options.add_command(commands, 'record', _record, _RECORD_HELP)
    options.add_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR',
                   help='output folder')
    p.add_argument('--topics', nargs='+', default=[], metavar='TOPIC',
                   help='also record these topics')
    p.add_argument('--results', action='store_true',
                   help='also record the results of the nodes (tracks, detections, calibrated '
                   'fields)')
    p.add_argument('--all', action='store_true', help='record all topics')
    p.add_argument('--split-mb', type=float, default=1000.0, metavar='N',
                   help='maximum size of a file [MB] (default: 1000)')
    p.add_argument('--split-s', type=float, default=3600.0, metavar='N',
                   help='maximum duration of a file [s] (default: 3600)')


def _run(args: argparse.Namespace) -> int:
    # Imported here, as in `_page_process`, because `record` does not need them.
    from mag_tracking.nodes.runner import run
    from mag_tracking.recording.reader import Recording

    settings = options.settings_of(args, read_network(args.network))
    ros_arguments = list(args.ros_arguments)
    if args.web is None and args.host != LOOPBACK:
        raise SettingsError('--host sets the address of the live page; add --web')
    if args.use_sim_time:
        ros_arguments += ['--ros-args', '-p', 'use_sim_time:=true']
    if args.recording:
        Recording(args.recording)
    with nullcontext() if args.web is None else _page_process(args.host, args.web, ros_arguments):
        return run(args.network, settings, args.recording, args.rate, args.loop,
                   () if args.quiet else None, drivers=args.drivers, batches=args.batches,
                   ros_arguments=ros_arguments)


@contextmanager
def _page_process(host: str, port: int, ros_arguments: Sequence[str]) -> Iterator[None]:
    """Run the live page in a process that cannot delay the nodes; raises DeviceError."""
    from mag_tracking.web.page_server import check_port

    check_port(host, port)
    # The page process ends when its stdin is closed, even if this process is killed.
    process = subprocess.Popen([
        sys.executable, '-m', 'mag_tracking.cli', 'ros', 'watch', '--host', host, '--port',
        str(port), '--until-eof', *ros_arguments], stdin=subprocess.PIPE)
    is_closing = threading.Event()

    def report_end() -> None:
        status = process.wait()
        if not is_closing.is_set():
            print(f'mag-tracking: the live page ended with status {status}', file=sys.stderr)

    threading.Thread(target=report_end, daemon=True).start()
    try:
        yield
    finally:
        is_closing.set()
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _record(args: argparse.Namespace) -> int:
    for option, value, minimum in (('--split-mb', args.split_mb, 0.1),
                                   ('--split-s', args.split_s, 1.0)):
        if not (math.isfinite(value) and value >= minimum):
            raise SettingsError(f'{option}: expected {minimum:g} or more, got {value:g}')
    for topic in args.topics:
        if not TOPIC_NAME_PATTERN.fullmatch(topic):
            raise SettingsError(f'--topics: {topic!r} is not a valid topic name')
    network = read_network(args.network)
    # Imported here because it needs ROS.
    from mag_tracking.nodes.record_node import run

    imu_topics = tuple(filter(None, network.imu_topics))
    selection = Selection(tuple(network.topics), imu_topics, tuple(args.topics), args.results,
                          args.all)
    return run(selection, args.out, int(args.split_mb * 1e6), int(args.split_s * 1e9),
               args.ros_arguments)
