"""Passages and traffic summaries as tables: CSV, and Parquet where pyarrow is installed."""

import csv
import secrets
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.errors import OutputError
from mag_tracking.event_records import TrafficSummary, VehiclePassage
from mag_tracking.files import new_text_file, output_folder

DIRECTIONS = {True: 'forward', False: 'backward'}


def passage_row(recording: str, passage: VehiclePassage, class_names: Sequence[str],
                delay: dict[str, Any], vehicle: dict[str, Any]) -> dict[str, Any]:
    """The columns of `passages`; SI units, NaN = unknown.

    `delay` has those of the speed by the delay between sensors, `vehicle` those of the enrolled
    vehicle that it is.
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
    """Rows of `intervals`, one for each direction and class; one with zero if there is none."""
    head = {'recording': recording, 'begin_ns': summary.begin_ns, 'end_ns': summary.end_ns,
            'line': summary.line, 'observed_s': summary.observed_s}
    if not summary.counts:
        return [{**head, 'direction': '', 'class': '', 'count': 0, 'ambiguous': 0,
                 'mean_speed': np.nan, 'mean_headway': np.nan}]
    return [{**head, 'direction': DIRECTIONS[c.forward], 'class': c.vehicle_class,
             'count': c.count, 'ambiguous': c.ambiguous, 'mean_speed': c.mean_speed,
             'mean_headway': c.mean_headway} for c in summary.counts]


def write_traffic(folder: Path, tables: dict[str, list[dict[str, Any]]]) -> list[Path]:
    """Write tables, {name: rows}, into a folder; returns the paths.

    Parquet is left out where pyarrow is not installed. Raises OutputError.
    """
    folder, paths = output_folder(folder), []
    try:
        for name, rows in tables.items():
            paths.append(folder / f'{name}.csv')
            with new_text_file(paths[-1], newline='') as stream:
                writer = csv.DictWriter(stream, list(rows[0]) if rows else [])
                writer.writeheader()
                writer.writerows({k: _text(v) for k, v in row.items()} for row in rows)
            if rows and find_spec('pyarrow') is not None:
                paths.append(folder / f'{name}.parquet')
                _write_parquet(paths[-1], rows)
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror or error}') from error
    return paths


def _text(value: object) -> object:
    """A cell of CSV; empty where the value is unknown."""
    if isinstance(value, float):
        return f'{value:.9g}' if np.isfinite(value) else ''
    return value


def _write_parquet(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a table; until it is complete, what was there stays."""
    # It takes half a second to import.
    import pyarrow as pa
    import pyarrow.parquet

    draft = path.with_name(f'.{secrets.token_hex(8)}.part')
    try:
        pyarrow.parquet.write_table(pa.table(
            {name: [None if isinstance(row[name], float) and np.isnan(row[name]) else row[name]
                    for row in rows] for name in rows[0]}), draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
