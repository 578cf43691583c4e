"""Tables `passages` and `events` of `mag-tracking replay`."""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.apps import traffic
from mag_tracking.cli.fit import time_of
from mag_tracking.cli.options import check_writable
from mag_tracking.errors import SettingsError
from mag_tracking.event_records import PassEvent
from mag_tracking.inference.identification import UNKNOWN, Identification
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline
from mag_tracking.quantities import quantity
from mag_tracking.results import columns, traffic_tables
from mag_tracking.run import RunReport
from mag_tracking.stages.events.stage import MAX_DURATION_S
from mag_tracking.units import NS


class Events:
    """Events of each recording; `upto` of each table is the last stage that it needs."""

    upto = 'calibrate'

    def __init__(self, args: argparse.Namespace, network: SensorNetwork,
                 stopped: Callable[[], bool], stack: ExitStack) -> None:
        self._names = network.names

    def sink(self, name: str, pipeline: Pipeline) -> traffic.EventSink:
        """Return the sink of a recording."""
        self._sink = traffic.EventSink(pipeline)
        return self._sink

    def finish(self, name: str, report: RunReport, out: Path | None) -> None:
        """Print one line per event and the number of events of each sensor; write the tables."""
        result = self._sink.result(report)
        for event in result.events:
            print(_event_line(event))
        counts = result.counts()
        print(', '.join(f'{name}: {quantity(counts.get(name, 0), "event")}'
                        for name in self._names))
        if out is not None:
            traffic_tables.write_events(out, result.events)


def _event_line(event: PassEvent) -> str:
    p = event.left_to_right
    direction = f'left to right ({p:.0%})' if p > 0.9 else f'right to left ({1.0 - p:.0%})' \
        if p < 0.1 else 'direction unknown'
    duration = (event.release_ns - event.onset_ns) / NS
    time = time_of(event.closest_ns)
    closest = f'closest {time} ± {event.closest_std:.2f} s' if np.isfinite(event.closest_std) \
        else f'peak at {time}, closest point unknown'
    if duration > MAX_DURATION_S:
        closest = f'from {time_of(event.onset_ns)} to {time_of(event.release_ns)}'
    return (f'{event.sensor} {event.number}: {closest}, duration {duration:.2f} s, peak '
            f'{1e9 * np.sqrt(np.nansum(event.peak**2)):.0f} nT on {event.axes}, {direction}'
            + ('' if event.ended else ', not ended'))


class Passages:
    """Passages of all recordings; the table is written after each recording."""

    upto = 'traffic'

    def __init__(self, args: argparse.Namespace, network: SensorNetwork,
                 stopped: Callable[[], bool], stack: ExitStack) -> None:
        self._args, self._network, self._stopped = args, network, stopped
        self._fleet = _fleet(args, network)
        self._tables: dict[str, list[dict[str, Any]]] = {'passages': [], 'intervals': []}
        self._enrolled: list[traffic_tables.FleetPass] = []

    def sink(self, name: str, pipeline: Pipeline) -> traffic.TrafficSink:
        """Return the sink of a recording."""
        self._sink = traffic.TrafficSink(pipeline)
        return self._sink

    def finish(self, name: str, report: RunReport, out: Path | None) -> None:
        """Print and write the passages of a recording; enrol the vehicle after the last one."""
        result, fleet = self._sink.result(report), self._fleet
        if self._args.enrol is not None and not self._stopped():
            self._enrolled.append(traffic.pass_of(name, [v.passage for v in result.vehicles]))
        identifications = [None if fleet is None else fleet.identify(v.passage)
                           for v in result.vehicles]
        _print(name, result, identifications)
        self._tables['passages'] += [
            traffic_tables.passage_row(
                name, v.passage, result.class_names, v.delays, {} if i is None else {
                    'vehicle': i.name, 'p_vehicle': i.probabilities.get(i.name, np.nan)})
            for v, i in zip(result.vehicles, identifications, strict=True)]
        self._tables['intervals'] += [row for s in result.summaries
                                      for row in traffic_tables.summary_rows(name, s)]
        if self._args.out is not None:
            # Written after each recording, so that an interruption loses nothing.
            traffic_tables.write_traffic(self._args.out, self._tables,
                                         columns.traffic_tables(result.class_names,
                                                                fleet is not None))
        if self._enrolled and len(self._enrolled) == len(self._args.recordings):
            _enrol(self._args, self._network, self._enrolled)


def _fleet(args: argparse.Namespace, network: SensorNetwork) -> traffic.Fleet | None:
    """Check --fleet and --enrol; return the fleet, or None with --enrol or without --fleet."""
    if args.enrol is not None:
        if args.fleet is None:
            raise SettingsError('--enrol requires a fleet file: add --fleet FILE')
        if args.enrol.strip() in ('', UNKNOWN):
            raise SettingsError(f'--enrol: {args.enrol!r} is not a valid name of a vehicle')
        traffic.earth_field_strength(network)
        check_writable(args.fleet)
        return None
    return traffic.Fleet(traffic_tables.read_fleet(args.fleet), network) if args.fleet else None


def _enrol(args: argparse.Namespace, network: SensorNetwork,
           passes: list[traffic_tables.FleetPass]) -> None:
    fleet = traffic_tables.read_fleet(args.fleet) if args.fleet.exists() else {}
    fleet[args.enrol] = [*fleet.get(args.enrol, []), *passes]
    # `Fleet` raises an error before a vehicle that cannot be enrolled is written.
    vehicle = next(v for v in traffic.Fleet(fleet, network).vehicles if v.name == args.enrol)
    traffic_tables.write_fleet(args.fleet, fleet)
    at = 'any heading' if vehicle.iron is not None else \
        f'a heading of {np.degrees(vehicle.heading):.0f} degrees only'
    print(f'{args.fleet}: {args.enrol} is recognised at {at} (passes: {len(fleet[args.enrol])})')


def _print(name: str, result: traffic.TrafficResult,
           identifications: Sequence[Identification | None]) -> None:
    for vehicle, identification in zip(result.vehicles, identifications, strict=True):
        identity = '' if identification is None else f', vehicle {identification.name}'
        print(f'{_passage_line(vehicle)}{identity}')
    passages = [v.passage for v in result.vehicles]
    counts = Counter((p.line, columns.DIRECTIONS[p.forward], p.vehicle_class) for p in passages)
    print(f'{name}: {quantity(len(result.vehicles), "vehicle")}')
    for (line, direction, vehicle_class), n in sorted(counts.items()):
        print(f'  {line}, {direction}, {vehicle_class}: {n}')
    n_ambiguous = sum(p.ambiguous for p in passages)
    warnings = {**({'ambiguous passages': n_ambiguous} if n_ambiguous else {}),
                **{cause: n for cause, n in result.report.counts['traffic'].items()
                  if n and cause != 'passages'}}
    for cause, n in warnings.items():
        print(f'  warning: {cause}: {n}')
    if result.report.no_track_reason:
        print(f'  {result.report.no_track_reason}')


def _passage_line(vehicle: traffic.CountedVehicle) -> str:
    p = vehicle.passage
    error = '' if np.isnan(p.direction_error) else f' (error probability {p.direction_error:.3f})'
    vehicle_class = f'{p.vehicle_class} ({p.class_probabilities.max():.0%})'
    length = f', {p.length:.1f} m' if p.length else ''
    headway = '' if np.isnan(p.headway) else f', headway {p.headway:.1f} s'
    delay = '' if vehicle.delay.reason else f', {vehicle.delay.speed:.1f} m/s from the delay'
    contradiction = ', speeds contradict each other' if vehicle.speeds_contradict else ''
    doubts = f', doubts: {", ".join(p.doubts)}' if p.doubts else ''
    return (f'{p.number} {time_of(p.stamp_ns)} {p.line}: {columns.DIRECTIONS[p.forward]}{error}, '
            f'{p.speed:.1f} ± {p.speed_std:.1f} m/s{delay}, '
            f'{vehicle_class}{length}{headway}{contradiction}{doubts}')
