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

_PASSAGES_BEGIN = '''
    recording number stamp_ns line track_id direction direction_error x y z lateral vx vy vz
    heading_deg sd_heading_deg speed sd_speed delay_speed sd_delay_speed speeds_contradict length
    sd_length mx my mz moment_size class'''
_PASSAGES_END = 'headway ambiguous doubts'
_INTERVALS = '''
    recording begin_ns end_ns line observed_s direction class count n_ambiguous mean_speed
    mean_headway'''
_TEXTS = ('recording', 'line', 'direction', 'class', 'vehicle', 'doubts')
_INTEGERS = ('number', 'stamp_ns', 'track_id', 'begin_ns', 'end_ns', 'count', 'n_ambiguous')
_FLAGS = ('ambiguous', 'speeds_contradict')


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
        return [{**head, 'direction': '', 'class': '', 'count': 0, 'n_ambiguous': 0,
                 'mean_speed': np.nan, 'mean_headway': np.nan}]
    return [{**head, 'direction': DIRECTIONS[c.forward], 'class': c.vehicle_class,
             'count': c.count, 'n_ambiguous': c.ambiguous, 'mean_speed': c.mean_speed,
             'mean_headway': c.mean_headway} for c in summary.counts]


def write_traffic(folder: Path, tables: dict[str, list[dict[str, Any]]],
                  class_names: Sequence[str], with_fleet: bool) -> list[Path]:
    """Write tables, {name: rows}, into a folder; returns the paths.

    Tables without rows have their columns. Parquet is left out where pyarrow is not installed, and
    that of an earlier run is removed. Raises OutputError.
    """
    folder, paths = output_folder(folder), []
    try:
        for name, rows in tables.items():
            columns = columns_of(name, class_names, with_fleet)
            paths.append(folder / f'{name}.csv')
            with new_text_file(paths[-1], newline='') as stream:
                writer = csv.DictWriter(stream, columns)
                writer.writeheader()
                writer.writerows({k: _text(v) for k, v in row.items()} for row in rows)
            parquet = folder / f'{name}.parquet'
            parquet.unlink(missing_ok=True)
            if find_spec('pyarrow') is not None:
                paths.append(parquet)
                _write_parquet(parquet, columns, rows)
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror or error}') from error
    return paths


def columns_of(table: str, class_names: Sequence[str], with_fleet: bool) -> list[str]:
    """The columns of `passages` or `intervals`."""
    return _INTERVALS.split() if table == 'intervals' else [
        *_PASSAGES_BEGIN.split(), *(f'p_{name}' for name in class_names),
        *(('vehicle', 'p_vehicle') if with_fleet else ()), *_PASSAGES_END.split()]


def _text(value: object) -> object:
    """A cell of CSV; empty where the value is unknown."""
    if isinstance(value, float):
        return f'{value:.9g}' if np.isfinite(value) else ''
    return value


def _write_parquet(path: Path, columns: Sequence[str], rows: list[dict[str, Any]]) -> None:
    """Write a table; the types of its columns do not depend on the rows."""
    # It takes half a second to import.
    import pyarrow as pa
    import pyarrow.parquet

    kinds = {**dict.fromkeys(_TEXTS, pa.string()), **dict.fromkeys(_INTEGERS, pa.int64()),
             **dict.fromkeys(_FLAGS, pa.bool_())}
    schema = pa.schema([(name, kinds.get(name, pa.float64())) for name in columns])
    draft = path.with_name(f'.{secrets.token_hex(8)}.part')
    try:
        pyarrow.parquet.write_table(pa.Table.from_pylist([
            {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in row.items()}
            for row in rows], schema), draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
