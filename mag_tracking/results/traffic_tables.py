"""Passages, traffic summaries, pass events and enrolled vehicles as tables."""

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.event_records import SIGNATURE_SPAN, PassEvent, TrafficSummary, VehiclePassage
from mag_tracking.files import checked_path, new_text_file, output_folder, replace_text
from mag_tracking.results.columns import (
    EVENTS,
    INTERVALS,
    SIGNATURES,
    Column,
    names_of,
    row_of,
    traffic_tables,
)
from mag_tracking.results.parquet_table import TableWriter
from mag_tracking.units import NS

FLEET_VERSION = 1


def event_row(event: PassEvent) -> list[object]:
    """Cells of an event by column; numbers with a unit have six significant digits."""
    row = row_of(EVENTS, event)
    return [_cell(row[c.name], 6) if c.kind == 'f' and c.unit else row[c.name] for c in EVENTS]


def write_events(folder: str | PathLike[str], events: Iterable[PassEvent]) -> None:
    """Write `events.csv` and `signatures.csv` to a folder."""
    folder, events = output_folder(folder), list(events)
    try:
        _write_csv(folder / 'events.csv', EVENTS, map(event_row, events))
        _write_csv(folder / 'signatures.csv', SIGNATURES, chain.from_iterable(
            map(_signature_rows, events)))
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror}') from error


def _signature_rows(event: PassEvent) -> Iterator[list[object]]:
    offsets_s = event.time_scale * np.linspace(-SIGNATURE_SPAN, SIGNATURE_SPAN,
                                               len(event.signature))
    closest_s = (event.closest_ns - event.onset_ns) / NS
    for t, field in zip(offsets_s, event.signature, strict=True):
        yield [event.sensor, event.number, *(_cell(v, 6) for v in (closest_s + t, *(1e9 * field)))]


def _write_csv(path: Path, columns: Iterable[Column], rows: Iterable[Iterable[object]]) -> None:
    with new_text_file(path, newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(names_of(columns))
        writer.writerows(rows)


@dataclass(frozen=True)
class FleetPass:
    """One pass of an enrolled vehicle."""

    moment: FloatArray
    """Magnetic moment, (3,) A m², world frame."""
    covariance: FloatArray
    """Covariance of `moment`, (3, 3) (A m²)², world frame."""
    heading: float
    """Heading, rad, anticlockwise from x."""
    source: str
    """Name of the recording, and index of the passage in it."""


def read_fleet(path: str | PathLike[str]) -> dict[str, list[FleetPass]]:
    """Passes of enrolled vehicles by name; raises RecordingError for a file of another version."""
    path = checked_path(path, RecordingError)
    try:
        with open(path, encoding='utf-8') as stream:
            content = json.load(stream)
        if content['mag_tracking.fleet'] != FLEET_VERSION:
            raise RecordingError(f'{path}: fleet version {content["mag_tracking.fleet"]} is not '
                                 f'supported; expected {FLEET_VERSION}')
        return {str(name): [FleetPass(
            np.array(p['moment'], dtype=float).reshape(3),
            np.array(p['covariance'], dtype=float).reshape(3, 3), float(p['heading']),
            str(p['source'])) for p in passes] for name, passes in content['vehicles'].items()}
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror}') from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            f'{path} is not a valid fleet file (missing or invalid: {error})') from error


def write_fleet(path: Path, fleet: dict[str, list[FleetPass]]) -> None:
    """Write the passes of enrolled vehicles atomically."""
    vehicles = {name: [{k: v.tolist() if isinstance(v, np.ndarray) else v
                        for k, v in asdict(p).items()} for p in passes]
                for name, passes in fleet.items()}
    replace_text(path, json.dumps({'mag_tracking.fleet': FLEET_VERSION, 'vehicles': vehicles},
                                  indent=1) + '\n')


def passage_row(recording: str, passage: VehiclePassage, class_names: Sequence[str],
                delay: dict[str, Any], vehicle: dict[str, Any]) -> dict[str, Any]:
    """Values of a passage by column; NaN if unknown; `delay` has the columns of the speed from the
    delay between sensors, `vehicle` those of the enrolled vehicle (empty without a fleet)."""
    known = {'recording': recording, **delay, **vehicle, **{
        f'p_{name}': float(p)
        for name, p in zip(class_names, passage.class_probabilities, strict=True)}}
    return row_of(traffic_tables(class_names, bool(vehicle))['passages'], passage, known)


def summary_rows(recording: str, summary: TrafficSummary) -> list[dict[str, Any]]:
    """Rows of the table `intervals`: one per direction and class, or one with count 0."""
    known = {'recording': recording, 'begin_ns': summary.begin_ns, 'end_ns': summary.end_ns,
             'line': summary.line, 'observed_s': summary.observed_s}
    if not summary.counts:
        return [{**known, 'direction': '', 'class': '', 'count': 0, 'n_ambiguous': 0}]
    return [row_of(INTERVALS, c, known) for c in summary.counts]


def write_traffic(folder: Path, rows: Mapping[str, Sequence[Mapping[str, Any]]],
                  tables: Mapping[str, Sequence[Column]]) -> None:
    """Write tables to a folder as CSV and, if pyarrow is installed, as Parquet; otherwise the
    Parquet files of an earlier run are removed."""
    folder = output_folder(folder)
    try:
        for name, columns in tables.items():
            _write_csv(folder / f'{name}.csv', columns, (
                [_cell(row.get(c.name, ''), 9) for c in columns] for row in rows[name]))
            parquet = folder / f'{name}.parquet'
            if find_spec('pyarrow') is None:
                parquet.unlink(missing_ok=True)
                continue
            with TableWriter(parquet, columns) as table:
                for row in rows[name]:
                    table.add(row)
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror or error}') from error


def _cell(value: object, digits: int) -> object:
    """Format a value as a cell of a CSV file; a number that is not finite becomes an empty cell."""
    if isinstance(value, float):
        return f'{value:.{digits}g}' if np.isfinite(value) else ''
    return value
