"""Command `mag-tracking info`."""

import argparse
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.network.file import read_network
from mag_tracking.network.topics import absolute, namespaces_of
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording


def add(commands: Commands) -> None:
    """Register the command.

    Parameters
    ----------
    commands : Commands
    """
    p = add_command(commands, 'info', _info)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    add_network(p, False, 'network file; report which of its topics are recorded')


def _info(args: argparse.Namespace) -> int:
    """Run `mag-tracking info`."""
    recording = Recording(args.recording)
    if not recording.message_counts:
        for message in recording.messages():
            recording.message_counts[message.topic] += 1
    print(f'{recording.path}: {recording.size / 1e6:.2f} MB, '
          f'{quantity(sum(recording.message_counts.values()), "message")}')
    if recording.start_ns is not None and recording.end_ns is not None:
        print(f'  {(recording.end_ns - recording.start_ns) / 1e9:.2f} s')
    if not recording.message_counts:
        print('  warning: the recording contains no messages')
    for topic in sorted(recording.types):
        print(f'  {topic}  {recording.types[topic]}  {recording.message_counts[topic]}')
    for cause, n in recording.losses.items():
        print(f'  warning: {cause}: {n}')
    if args.network:
        network = read_network(args.network)
        namespaces = namespaces_of(network.topics, recording.types) or ['/']
        if len(namespaces) > 1:
            print(f'  namespaces with topics of the network: {", ".join(namespaces)}')
        for name, topic in zip(network.names, network.topics, strict=True):
            topic = absolute(topic, namespaces[0])
            state = 'recorded' if topic in recording.types else 'MISSING'
            print(f'  sensor {name}: {topic} is {state}')
    return 0
