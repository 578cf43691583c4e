"""Command `mag-tracking traffic`."""

import argparse
import signal
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.apps.fleet import Fleet, earth_field_strength, pass_of
from mag_tracking.apps.traffic import CountedVehicle, TrafficResult, count_traffic
from mag_tracking.cli.options import (
    Commands,
    add_command,
    add_recorded_network,
    check_writable,
    distinct_names,
    print_diagnoses,
    progress_bar,
    recorded_network,
)
from mag_tracking.cli.tracking_options import add_settings, settings_of
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.files import output_folder
from mag_tracking.inference.identification import Identification
from mag_tracking.inference.log_normal_classes import UNKNOWN
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.results.columns import DIRECTIONS, traffic_tables
from mag_tracking.results.fleet_file import FleetPass, read_fleet, write_fleet
from mag_tracking.results.traffic_tables import passage_row, summary_rows, write_traffic
from mag_tracking.run import RecordingSource
from mag_tracking.units import NS

_TRAFFIC_HELP = '''
Tracks the vehicles in each recording. Counts each vehicle that crosses a line, and reports its
time, direction, speed, length, class and headway. The default line is perpendicular to the x axis,
through the centre of the network; the settings traffic.line_* define other lines. A vehicle is
counted when its track has ended. Ambiguous passages are counted and marked.

With --out, writes passages.csv (one row per vehicle) and intervals.csv (counts and mean speeds per
interval, direction and class) to DIR, and the same tables as Parquet if pyarrow is installed.

With --fleet, enrolled vehicles are recognised by their hard and soft iron. --enrol NAME adds the
vehicle in each recording, which must be the only one, to the fleet file. A vehicle enrolled at
headings at least 45 degrees apart is recognised at any heading, otherwise only at the enrolled
heading.

examples:
  mag-tracking traffic road.mcap --network network.yaml
  mag-tracking traffic out.mcap back.mcap --network site.yaml --fleet fleet.json --enrol 'van 3'
  mag-tracking traffic monday.mcap tuesday.mcap --network network.yaml --out week
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'traffic', _traffic, _TRAFFIC_HELP)
    p.add_argument('recordings', type=Path, nargs='+', metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    add_recorded_network(p)
    p.add_argument('--out', type=Path, metavar='DIR', help='output folder')
    p.add_argument('--fleet', type=Path, metavar='FILE',
                   help='fleet file with the enrolled vehicles (.json)')
    p.add_argument('--enrol', metavar='NAME',
                   help='add the vehicle of each recording to the fleet file under this name')
    add_settings(p)


def _traffic(args: argparse.Namespace) -> int:
    """Run `mag-tracking traffic`."""
    network = recorded_network(args)
    settings = settings_of(args, network)
    names = distinct_names(args.recordings)
    sources = _sources(args, network)
    tables: dict[str, list[dict[str, Any]]] = {'passages': [], 'intervals': []}
    fleet = _fleet(args, network)
    enrolled: list[FleetPass] = []
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals:
        for name, source in zip(names, sources, strict=True):
            if signals:
                break
            with progress_bar(source) as bar:
                result = count_traffic(source, network, settings, bar.update,
                                       lambda: bool(signals))
            if args.enrol is not None and not signals:
                enrolled.append(pass_of(name, [v.passage for v in result.vehicles]))
            identifications = [None if fleet is None else fleet.identify(v.passage)
                               for v in result.vehicles]
            _print(name, result, identifications)
            tables['passages'] += [
                passage_row(name, v.passage, result.class_names, _delay(v),
                            _vehicle(identification))
                for v, identification in zip(result.vehicles, identifications, strict=True)]
            tables['intervals'] += [row for s in result.summaries for row in summary_rows(name, s)]
            if args.out is not None:
                # Written after each recording, so that an interruption loses nothing.
                write_traffic(args.out, tables,
                              traffic_tables(result.class_names, fleet is not None))
    if args.enrol is not None and not signals:
        _enrol(args, network, enrolled)
    if args.out is not None:
        print(f'tables in {args.out}')
    if signals:
        print('interrupted: the results cover only the part read so far')
        return 130
    return 0


def _sources(args: argparse.Namespace, network: SensorNetwork) -> list[RecordingSource]:
    """Open all recordings; check their topics and the output folder before the run begins."""
    sources = [RecordingSource(Recording(path), network) for path in args.recordings]
    if args.out is not None:
        if any(source.recording.lies_in(args.out) for source in sources):
            raise OutputError(f'--out: {args.out} is the folder of a recording; choose another '
                              'one')
        output_folder(args.out)
    return sources


def _fleet(args: argparse.Namespace, network: SensorNetwork) -> Fleet | None:
    """Check --fleet and --enrol; return the fleet, or None with --enrol or without --fleet."""
    if args.enrol is not None:
        if args.fleet is None:
            raise SettingsError('--enrol requires a fleet file: add --fleet FILE')
        if args.enrol.strip() in ('', UNKNOWN):
            raise SettingsError(f'--enrol: {args.enrol!r} is not a valid name of a vehicle')
        earth_field_strength(network)
        check_writable(args.fleet)
        return None
    return None if args.fleet is None else Fleet(read_fleet(args.fleet), network)


def _enrol(args: argparse.Namespace, network: SensorNetwork, passes: list[FleetPass]) -> None:
    """Add passes of the vehicle named by --enrol to the fleet file."""
    fleet = read_fleet(args.fleet) if args.fleet.exists() else {}
    fleet[args.enrol] = [*fleet.get(args.enrol, []), *passes]
    # Fleet raises an error before a vehicle that cannot be enrolled is written.
    vehicle = next(v for v in Fleet(fleet, network).vehicles if v.name == args.enrol)
    write_fleet(args.fleet, fleet)
    at = 'any heading' if vehicle.iron is not None else \
        f'a heading of {np.degrees(vehicle.heading):.0f} degrees only'
    print(f'{args.fleet}: {args.enrol} is recognised at {at} (passes: {len(fleet[args.enrol])})')


def _vehicle(identification: Identification | None) -> dict[str, Any]:
    """Return the table columns of the identified vehicle; an empty dict without a fleet file."""
    return {} if identification is None else {
        'vehicle': identification.name,
        'p_vehicle': identification.probabilities.get(identification.name, np.nan)}


def _delay(vehicle: CountedVehicle) -> dict[str, Any]:
    """Return the table columns of the speed from the delay between sensors."""
    return {'delay_speed': vehicle.delay.speed, 'sd_delay_speed': vehicle.delay.speed_std,
            'speeds_contradict': vehicle.speeds_contradict}


def _print(name: str, result: TrafficResult,
           identifications: Sequence[Identification | None]) -> None:
    """Print the diagnoses of a recording, one line per vehicle, the counts, and warnings."""
    print_diagnoses(result.report.diagnoses)
    for vehicle, identification in zip(result.vehicles, identifications, strict=True):
        identity = '' if identification is None else f', vehicle {identification.name}'
        print(f'{line_of(vehicle)}{identity}')
    counts = Counter((v.passage.line, DIRECTIONS[v.passage.forward], v.passage.vehicle_class)
                     for v in result.vehicles)
    print(f'{name}: {quantity(len(result.vehicles), "vehicle")}')
    for (line, direction, vehicle_class), n in sorted(counts.items()):
        print(f'  {line}, {direction}, {vehicle_class}: {n}')
    n_ambiguous = sum(v.passage.ambiguous for v in result.vehicles)
    warnings = {**({'ambiguous passages': n_ambiguous} if n_ambiguous else {}),
                **{cause: n for cause, n in result.report.counts['traffic'].items()
                  if n and cause != 'passages'}}
    for cause, n in warnings.items():
        print(f'  warning: {cause}: {n}')
    if result.report.no_track_reason:
        print(f'  {result.report.no_track_reason}')


def line_of(vehicle: CountedVehicle) -> str:
    """Describe a passage in one line."""
    p = vehicle.passage
    time = datetime.fromtimestamp(p.stamp_ns / NS, tz=UTC)
    error = '' if np.isnan(p.direction_error) else f' (error probability {p.direction_error:.3f})'
    vehicle_class = f'{p.vehicle_class} ({p.class_probabilities.max():.0%})'
    length = f', {p.length:.1f} m' if p.length else ''
    headway = '' if np.isnan(p.headway) else f', headway {p.headway:.1f} s'
    delay = '' if vehicle.delay.reason else f', {vehicle.delay.speed:.1f} m/s from the delay'
    contradiction = ', speeds contradict each other' if vehicle.speeds_contradict else ''
    doubts = f', doubts: {", ".join(p.doubts)}' if p.doubts else ''
    return (f'{p.number} {time:%H:%M:%S}.{time.microsecond // 10000:02d} {p.line}: '
            f'{DIRECTIONS[p.forward]}{error}, {p.speed:.1f} ± {p.speed_std:.1f} m/s{delay}, '
            f'{vehicle_class}{length}{headway}{contradiction}{doubts}')
