"""Passages and traffic summaries as tables: CSV, and Parquet if pyarrow is installed."""

import csv
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.errors import OutputError
from mag_tracking.event_records import TrafficSummary, VehiclePassage
from mag_tracking.files import new_text_file, output_folder
from mag_tracking.results.parquet_table import Column, TableWriter, columns_of

DIRECTIONS = {True: 'forward', False: 'backward'}

_PASSAGE_COLUMNS = (
    *columns_of('s', '', recording='name of the recording'),
    *columns_of('i', '', number='index of the passage in chronological order, from 1'),
    *columns_of('i', 'ns', stamp_ns='time at which the middle of the vehicle was on the line'),
    *columns_of('s', '', line='name of the counting line'),
    *columns_of('i', '', track_id='identifier of the track'),
    *columns_of('s', '', direction='direction across the line: forward or backward'),
    *columns_of('f', '', direction_error='probability that the direction is wrong'),
    *columns_of('f', 'm', x='position on the line, x', y='position on the line, y',
                z='position on the line, z',
                lateral='distance from the middle of the line, positive to the left of the '
                        'forward direction'),
    *columns_of('f', 'm/s', vx='velocity, x', vy='velocity, y', vz='velocity, z'),
    *columns_of('f', 'deg', heading_deg='direction of the velocity, anticlockwise from x',
                sd_heading_deg='standard deviation of the heading'),
    *columns_of('f', 'm/s', speed='horizontal speed', sd_speed='standard deviation of the speed',
                delay_speed='model-free speed from the delay between sensors',
                sd_delay_speed='standard deviation of the model-free speed'),
    *columns_of('b', '',
                speeds_contradict='whether the speeds of track and delay contradict each other'),
    *columns_of('f', 'm', length='length of the row of dipoles; 0 for a point target',
                sd_length='standard deviation of the length'),
    *columns_of('f', 'A m^2', mx='magnetic moment, x', my='magnetic moment, y',
                mz='magnetic moment, z', moment_size='magnitude of the magnetic moment'),
    Column('class', 's', '', 'most probable class, or unknown'))
_VEHICLE_COLUMNS = (
    *columns_of('s', '', vehicle='name of the matching enrolled vehicle, or unknown'),
    *columns_of('f', '', p_vehicle='probability of the vehicle among the enrolled vehicles that '
                                   'can be compared at this heading'))
_FINAL_COLUMNS = (
    *columns_of('f', 's', headway='time since the previous vehicle in the same direction'),
    *columns_of('b', '', ambiguous='whether the passage is ambiguous'),
    *columns_of('s', '', doubts='reasons why the passage is ambiguous'))
_INTERVAL_COLUMNS = (
    *columns_of('s', '', recording='name of the recording'),
    *columns_of('i', 'ns', begin_ns='beginning of the interval',
                end_ns='end of the interval'),
    *columns_of('s', '', line='name of the counting line'),
    *columns_of('f', 's', observed_s='time within the interval that is covered by frames'),
    *columns_of('s', '', direction='direction across the line: forward or backward'),
    Column('class', 's', '', 'class of the vehicles'),
    *columns_of('i', '', count='number of vehicles', n_ambiguous='number of ambiguous passages'),
    *columns_of('f', 'm/s', mean_speed='mean speed of the vehicles'),
    *columns_of('f', 's', mean_headway='mean headway of the vehicles'))


def tables_of(class_names: Sequence[str], with_fleet: bool) -> dict[str, tuple[Column, ...]]:
    """Columns of the tables `passages` and `intervals`, with a probability per class."""
    classes = tuple(Column(f'p_{name}', 'f', '', f'probability of the class {name}')
                    for name in class_names)
    vehicle = _VEHICLE_COLUMNS if with_fleet else ()
    return {'passages': (*_PASSAGE_COLUMNS, *classes, *vehicle, *_FINAL_COLUMNS),
            'intervals': _INTERVAL_COLUMNS}


def passage_row(recording: str, passage: VehiclePassage, class_names: Sequence[str],
                delay: dict[str, Any], vehicle: dict[str, Any]) -> dict[str, Any]:
    """Values of a passage by column, in the units of the table; NaN if unknown.

    `delay` has the columns of the speed from the delay between sensors, `vehicle` those of the
    matching enrolled vehicle (empty without a fleet).
    """
    x, y, z = passage.position.tolist()
    vx, vy, vz = passage.velocity.tolist()
    mx, my, mz = passage.moment.tolist()
    return {
        'recording': recording, 'number': passage.number, 'stamp_ns': passage.stamp_ns,
        'line': passage.line, 'track_id': passage.track_id,
        'direction': DIRECTIONS[passage.forward], 'direction_error': passage.direction_error,
        'x': x, 'y': y, 'z': z, 'lateral': passage.lateral, 'vx': vx, 'vy': vy, 'vz': vz,
        'heading_deg': float(np.degrees(np.arctan2(vy, vx))),
        'sd_heading_deg': float(np.degrees(passage.heading_std)),
        'speed': passage.speed, 'sd_speed': passage.speed_std, **delay,
        'length': passage.length, 'sd_length': passage.length_std, 'mx': mx, 'my': my, 'mz': mz,
        'moment_size': float(np.linalg.norm(passage.moment)), 'class': passage.vehicle_class,
        **{f'p_{name}': float(p) for name, p in zip(class_names, passage.class_probabilities,
                                                    strict=True)},
        **vehicle, 'headway': passage.headway, 'ambiguous': passage.ambiguous,
        'doubts': ' '.join(passage.doubts)}


def summary_rows(recording: str, summary: TrafficSummary) -> list[dict[str, Any]]:
    """Rows of the table `intervals`: one per direction and class, or one with count 0."""
    common_values = {'recording': recording, 'begin_ns': summary.begin_ns, 'end_ns': summary.end_ns,
                     'line': summary.line, 'observed_s': summary.observed_s}
    if not summary.counts:
        return [{**common_values, 'direction': '', 'class': '', 'count': 0, 'n_ambiguous': 0,
                 'mean_speed': np.nan, 'mean_headway': np.nan}]
    return [{**common_values, 'direction': DIRECTIONS[c.forward], 'class': c.vehicle_class,
             'count': c.count, 'n_ambiguous': c.ambiguous, 'mean_speed': c.mean_speed,
             'mean_headway': c.mean_headway} for c in summary.counts]


def write_traffic(folder: Path, rows: Mapping[str, Sequence[Mapping[str, Any]]],
                  tables: Mapping[str, Sequence[Column]]) -> None:
    """Write tables to a folder as CSV and Parquet.

    Tables without rows have only a header. Without pyarrow, no Parquet files are written, and those
    of an earlier run are removed.
    """
    folder = output_folder(folder)
    try:
        for name, columns in tables.items():
            with new_text_file(folder / f'{name}.csv', newline='') as stream:
                writer = csv.DictWriter(stream, [c.name for c in columns])
                writer.writeheader()
                writer.writerows({k: _csv_value(v) for k, v in row.items()} for row in rows[name])
            parquet = folder / f'{name}.parquet'
            if find_spec('pyarrow') is None:
                parquet.unlink(missing_ok=True)
                continue
            with TableWriter(parquet, columns) as table:
                for row in rows[name]:
                    # Unknown values are NaN here and null in Parquet.
                    table.add({k: v for k, v in row.items() if v == v})
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror or error}') from error


def _csv_value(value: object) -> object:
    """Format a value as a cell of a CSV file; a number that is not finite becomes an empty cell."""
    if isinstance(value, float):
        return f'{value:.9g}' if np.isfinite(value) else ''
    return value
