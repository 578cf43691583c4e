"""Command `mag-tracking info`."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from mag_tracking.apps.info import Source, Timing, time_topics
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import absolute, namespaces_of
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'info', _info)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    add_network(p, False, 'network file; report which of its topics are recorded')


def _info(args: argparse.Namespace) -> int:
    """Run `mag-tracking info`."""
    recording = Recording(args.recording)
    with tqdm(total=recording.size, unit='B', unit_scale=True, desc=args.recording.name,
              disable=None) as bar:
        timings, faults, counts = time_topics(recording, bar.update)
    print(f'{recording.path}: {recording.size / 1e6:.2f} MB, '
          f'{quantity(counts.total(), "message")}')
    _print_duration(recording, list(timings.values()))
    if not counts:
        print('  warning: the recording contains no messages')
    by_topic: dict[str, dict[str, Timing]] = {}
    for source, timing in timings.items():
        by_topic.setdefault(source.topic, {})[source.sensor] = timing
    for topic in sorted(recording.types):
        _print_topic(topic, recording.types[topic], counts[topic], by_topic.get(topic, {}))
    for cause, n in {**faults, **recording.losses}.items():
        print(f'  warning: {cause}: {n}')
    if args.network:
        _print_sensors(read_network(args.network), recording, timings)
    return 0


def _print_duration(recording: Recording, timings: Sequence[Timing]) -> None:
    """Print the duration by the log times, or by the timestamps if they contradict each other."""
    wrong = next((timing for timing in timings if timing.clocks_disagree), None)
    if wrong is not None:
        print(f'  {wrong.span_s:.2f} s by the timestamps\n  warning: the log times span '
              f'{wrong.log_span_s:.2f} s: the clock of the recorder jumped or was wrong, or the '
              'timestamps are')
    elif recording.start_ns is not None and recording.end_ns is not None:
        print(f'  {(recording.end_ns - recording.start_ns) / 1e9:.2f} s')


def _print_topic(topic: str, kind: str, n: int, timings: Mapping[str, Timing]) -> None:
    """Print a topic of `n` messages with rate and gaps, by sensor if there are several."""
    rate = next(iter(timings.values())).describe() if len(timings) == 1 else ''
    print(f'  {topic}  {kind}  {n}' + (f'  {rate}' if rate else ''))
    if len(timings) > 1:
        for sensor, timing in timings.items():
            print(f'    {sensor or "no frame_id"}  {timing.n_messages}  {timing.describe()}')


def _print_sensors(network: SensorNetwork, recording: Recording,
                   timings: Mapping[Source, Timing]) -> None:
    """Print which sensors of the network are recorded."""
    namespaces = namespaces_of(network.topics, recording.types) or ['/']
    if len(namespaces) > 1:
        print(f'  namespaces with topics of the network: {", ".join(namespaces)}')
    for name, topic in zip(network.names, network.topics, strict=True):
        topic = absolute(topic, namespaces[0])
        kind = recording.types.get(topic)
        state = 'MISSING' if kind is None else 'recorded' if kind == MAGNETIC_FIELD \
            else f'recorded as {kind}, not {MAGNETIC_FIELD}'
        shared = sorted({source.topic for source in timings if source.sensor == name})
        if kind is None and shared:
            state = f'not recorded, but its frame_id is on {", ".join(shared)}'
        print(f'  sensor {name}: {topic} is {state}')
