"""Command `mag-tracking events`."""

import argparse
import signal
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mag_tracking.apps.events import EventsResult, find_events
from mag_tracking.cli.options import (
    Commands,
    add_command,
    add_recorded_network,
    print_diagnoses,
    progress_bar,
    recorded_network,
)
from mag_tracking.cli.tracking_options import add_settings, settings_of
from mag_tracking.errors import OutputError
from mag_tracking.event_records import PassEvent
from mag_tracking.interrupts import recorded_signals
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.results.event_tables import write_events
from mag_tracking.run import RecordingSource
from mag_tracking.stages.events.stage import MAX_DURATION_S
from mag_tracking.units import NS

_EVENTS_HELP = '''
Detects the passes at each sensor and describes them without tracking: onset and release, peak,
energy, time of the closest point of approach, direction (needs two horizontal axes), and the
signature of the field. One sensor with one axis is sufficient. Distance and speed are not
observable with a single sensor, so no value is in metres. The stay of a parked vehicle is one
event. Sensors that are too slow to show passes still show stays.

With --out, writes events.csv and signatures.csv to DIR.

examples:
  mag-tracking events road.mcap --network network.yaml
  mag-tracking events road.bag --network one_sensor.yaml --out events
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'events', _events, _EVENTS_HELP)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--out', type=Path, metavar='DIR', help='output folder')
    add_settings(p)


def _events(args: argparse.Namespace) -> int:
    """Run `mag-tracking events`."""
    network = recorded_network(args)
    settings = settings_of(args, network)
    source = RecordingSource(Recording(args.recording), network)
    if args.out is not None and source.recording.lies_in(args.out):
        raise OutputError(f'--out: {args.out} is the folder of the recording; choose another one')
    with recorded_signals(signal.SIGINT) as signals, progress_bar(source) as bar:
        result = find_events(source, network, settings, bar.update, lambda: bool(signals))
    _print(result, network.names)
    if args.out is not None:
        write_events(args.out, result.events)
        print(f'tables in {args.out}')
    if signals:
        print('interrupted: the results cover only the part read so far')
        return 130
    return 0


def _print(result: EventsResult, names: tuple[str, ...]) -> None:
    """Print the diagnoses, one line per event, and the number of events of each sensor."""
    print_diagnoses(result.report.diagnoses)
    for event in result.events:
        print(line_of(event))
    counts = result.counts()
    print(', '.join(f'{name}: {quantity(counts.get(name, 0), "event")}' for name in names))


def line_of(event: PassEvent) -> str:
    """Describe an event in one line."""
    p = event.left_to_right
    direction = f'left to right ({p:.0%})' if p > 0.9 else f'right to left ({1.0 - p:.0%})' \
        if p < 0.1 else 'direction unknown'
    duration = (event.release_ns - event.onset_ns) / NS
    time = _time_of(event.closest_ns)
    closest = f'closest {time} ± {event.closest_std:.2f} s' if np.isfinite(event.closest_std) \
        else f'peak at {time}, closest point unknown'
    if duration > MAX_DURATION_S:
        closest = f'from {_time_of(event.onset_ns)} to {_time_of(event.release_ns)}'
    return (f'{event.sensor} {event.number}: {closest}, duration {duration:.2f} s, peak '
            f'{1e9 * np.sqrt(np.nansum(event.peak**2)):.0f} nT on {event.axes}, {direction}'
            + ('' if event.ended else ', not ended'))


def _time_of(stamp_ns: int) -> str:
    """Time of day of a timestamp."""
    time = datetime.fromtimestamp(stamp_ns / NS, tz=UTC)
    return f'{time:%H:%M:%S}.{time.microsecond // 10000:02d}'
