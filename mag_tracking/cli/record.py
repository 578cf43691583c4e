"""Command `mag-tracking record`."""

import argparse
import math
from pathlib import Path

from mag_tracking.apps.record import Selection
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.errors import SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import TOPIC_NAME_PATTERN

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


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'record', _record, _RECORD_HELP)
    add_network(p)
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


def _record(args: argparse.Namespace) -> int:
    """Run `mag-tracking record`."""
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
