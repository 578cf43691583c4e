"""mag-tracking run, info and import."""

from pathlib import Path

from mag_tracking.cli.options import add_command, add_network, add_settings, settings_of
from mag_tracking.io.bag import Recording
from mag_tracking.io.network_file import read_network

_RUN = '''
Starts calibration, detection and tracker nodes in one process, and with a
RECORDING the replay node, with DRIVERS the driver node as well. Drivers of your
own publish sensor_msgs/MagneticField on the topics of the network file. Ctrl-C
ends it.

examples:
  mag-tracking run --network config/network.yaml --drivers config/drivers.yaml
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


def add(commands):
    """Register the commands."""
    p = add_command(commands, 'run', _run, 'Run the nodes in one process (needs ROS 2).', _RUN)
    add_network(p)
    add_settings(p)
    p.add_argument('--recording', type=Path, metavar='RECORDING', help='replay this, too')
    p.add_argument('--drivers', type=Path, metavar='DRIVERS',
                   help='run the devices of this drivers file, too')
    p.add_argument('--batches', action='store_true',
                   help='the drivers put readings of many sensors in one message, which dozens of '
                   'sensors need')
    p.add_argument('--rate', type=float, default=1.0, help='speed of the replay (default: 1)')
    p.add_argument('--loop', action='store_true', help='begin again at the end')

    p = add_command(commands, 'info', _info, 'Tell what is in a recording.')
    p.add_argument('recording', type=Path, metavar='RECORDING')
    add_network(p, False, 'compare with its topics')

    p = add_command(commands, 'import', _import, 'Turn a table of magnet poses into a recording.',
                    _IMPORT)
    p.add_argument('table', type=Path, metavar='POSES.csv')
    p.add_argument('--background', required=True, type=Path, metavar='FILE.csv')
    p.add_argument('--out', required=True, type=Path, metavar='DIR')
    p.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                   help='noise of one reading (default: 1e-6)')


def _run(args):
    """mag-tracking run."""
    # Only this command needs ROS.
    from mag_tracking.nodes.runner import run

    settings = settings_of(args)
    read_network(args.network)
    if args.recording:
        Recording(args.recording)
    return run(args.network, settings, args.recording, args.rate, args.loop,
               drivers=args.drivers, batches=args.batches)


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
