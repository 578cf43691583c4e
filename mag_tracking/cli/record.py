"""mag-tracking record."""

import argparse
import math
from pathlib import Path

from mag_tracking.apps.record import Selection
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.errors import SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.network.topics import NAME

_RECORD = '''
Records the magnetic fields of the network's topics, as they are, until Ctrl-C,
and where they appear the sensors' sensor_msgs/Imu topics (/mag_1/imu/data_raw
beside /mag_1/imu/mag). DIR becomes a rosbag2 recording: MCAP files and a
metadata.yaml. Whatever is lost, before it came or on a full disk, is counted
and told; after a full disk it goes on in a new file. After a crash less than a
second is missing; `mag-tracking repair DIR` then gives the file its index.

examples:
  mag-tracking record --network config/network.yaml --out night
  mag-tracking record --network site.yaml --out night --results --split-s 600
  mag-tracking record --network site.yaml --out night --topics /camera /gps/fix
  mag-tracking record --network site.yaml --out night --ros-args -r __ns:=/robot1
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'record', _record, _RECORD)
    add_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR',
                   help='folder for the recording')
    p.add_argument('--topics', nargs='+', default=[], metavar='TOPIC', help='record these, too')
    p.add_argument('--results', action='store_true',
                   help='what the nodes make of it, too (tracks, detections, calibrated fields)')
    p.add_argument('--all', action='store_true', help='record every topic')
    p.add_argument('--split-mb', type=float, default=1000.0, metavar='N',
                   help='size of a file in MB (default: 1000)')
    p.add_argument('--split-s', type=float, default=3600.0, metavar='N',
                   help='time in a file in s (default: 3600)')


def _record(args: argparse.Namespace) -> int:
    """mag-tracking record."""
    for option, value, least in (('--split-mb', args.split_mb, 0.1),
                                 ('--split-s', args.split_s, 1.0)):
        if not (math.isfinite(value) and value >= least):
            raise SettingsError(f'{option}: {value:g} is not a number of at least {least:g}')
    for topic in args.topics:
        if not NAME.fullmatch(topic):
            raise SettingsError(f'--topics: {topic!r} is not the name of a topic')
    network = read_network(args.network)
    # Only this command needs ROS.
    from mag_tracking.nodes.record_node import run

    imus = tuple(filter(None, network.imu_topics))
    selection = Selection(tuple(network.topics), imus, tuple(args.topics), args.results, args.all)
    return run(selection, args.out, int(args.split_mb * 1e6), int(args.split_s * 1e9),
               args.ros_arguments)
