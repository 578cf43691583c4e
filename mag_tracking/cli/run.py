"""Command `mag-tracking run`."""

import argparse
from contextlib import nullcontext
from pathlib import Path

from mag_tracking.cli.live_page import add_page, page_process
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.cli.tracking_options import add_settings, settings_of
from mag_tracking.errors import SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.recording.reader import Recording
from mag_tracking.web.page_server import DEFAULT_PORT, LOOPBACK

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


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'run', _run, _RUN_HELP)
    add_network(p)
    add_settings(p)
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
    add_page(p, port=False)


def _run(args: argparse.Namespace) -> int:
    """Run `mag-tracking run`."""
    # Imported here because it needs ROS.
    from mag_tracking.nodes.runner import run

    settings = settings_of(args, read_network(args.network))
    ros_arguments = list(args.ros_arguments)
    if args.web is None and args.host != LOOPBACK:
        raise SettingsError('--host sets the address of the live page; add --web')
    if args.use_sim_time:
        ros_arguments += ['--ros-args', '-p', 'use_sim_time:=true']
    if args.recording:
        Recording(args.recording)
    with nullcontext() if args.web is None else page_process(args.host, args.web, ros_arguments):
        return run(args.network, settings, args.recording, args.rate, args.loop,
                   () if args.quiet else None, drivers=args.drivers, batches=args.batches,
                   ros_arguments=ros_arguments)
