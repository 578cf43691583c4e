"""mag-tracking run."""

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

_RUN = '''
Starts calibration, detection and tracker nodes in one process, and with a
RECORDING the replay node, with DRIVERS the driver node as well. The nodes call each
other, without messages between them; what they publish comes after the pose, and what
is only between them, calibrated fields and frames, where somebody listens. Drivers of your
own publish sensor_msgs/MagneticField on the topics of the network file. Ctrl-C
ends it. Arguments of ROS (--ros-args ...) come last.

examples:
  mag-tracking run --network config/network.yaml --drivers config/drivers.yaml
  mag-tracking run --network config/network.yaml --recording junction.mcap --rate 2
  mag-tracking run --network config/network.yaml --recording junction.mcap --loop --web
  mag-tracking run --network config/network.yaml --ros-args -r __ns:=/robot1
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'run', _run, _RUN)
    add_network(p)
    add_settings(p)
    p.add_argument('--recording', type=Path, metavar='RECORDING', help='replay this, too')
    p.add_argument('--drivers', type=Path, metavar='DRIVERS',
                   help='run the devices of this drivers file, too')
    p.add_argument('--batches', action='store_true',
                   help='the drivers put readings of many sensors in one message, which dozens of '
                   'sensors need')
    p.add_argument('--use-sim-time', action='store_true',
                   help='take the time from /clock, as where a bag is played')
    p.add_argument('--rate', type=float, default=1.0, help='speed of the replay (default: 1)')
    p.add_argument('--loop', action='store_true', help='begin again at the end')
    p.add_argument('--web', type=int, nargs='?', const=DEFAULT_PORT, metavar='PORT',
                   help=f'serve a live page (default port: {DEFAULT_PORT})')
    add_page(p, port=False)


def _run(args: argparse.Namespace) -> int:
    """mag-tracking run."""
    # Only this command needs ROS.
    from mag_tracking.nodes.runner import run

    settings, ros_arguments = settings_of(args), list(args.ros_arguments)
    if args.web is None and args.host != LOOPBACK:
        raise SettingsError('--host is the address of the live page: add --web')
    if args.use_sim_time:
        ros_arguments += ['--ros-args', '-p', 'use_sim_time:=true']
    read_network(args.network)
    if args.recording:
        Recording(args.recording)
    with nullcontext() if args.web is None else page_process(args.host, args.web, ros_arguments):
        return run(args.network, settings, args.recording, args.rate, args.loop,
                   drivers=args.drivers, batches=args.batches, ros_arguments=ros_arguments)
