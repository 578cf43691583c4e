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
from mag_tracking.results.columns import INTERVALS, Column, row_of, traffic_tables
from mag_tracking.results.parquet_table import TableWriter


def passage_row(recording: str, passage: VehiclePassage, class_names: Sequence[str],
                delay: dict[str, Any], vehicle: dict[str, Any]) -> dict[str, Any]:
    """Values of a passage by column, in the units of the table; NaN if unknown.

    `delay` has the columns of the speed from the delay between sensors, `vehicle` those of the
    matching enrolled vehicle (empty without a fleet).
    """
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
                    table.add(row)
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror or error}') from error


def _csv_value(value: object) -> object:
    """Format a value as a cell of a CSV file; a number that is not finite becomes an empty cell."""
    if isinstance(value, float):
        return f'{value:.9g}' if np.isfinite(value) else ''
    return value
