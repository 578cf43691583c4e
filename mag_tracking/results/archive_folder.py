"""Folder of an archive: tables of Parquet files, with one file per recording and day.

    DIR/archive.json                    schema, network and settings
    DIR/TABLE/date=2026-03-01/NAME.parquet
    DIR/done/NAME.json                  written last; marks a recording as processed
    DIR/unfinished/NAME.STATE/          partial results, from which the next run resumes

NAME is the stem of the recording and a hash of its path. STATE is a hash of the program version and
of the names, sizes and modification times of the recording's files. pyarrow is imported when a
table is written or read.
"""

import datetime
import glob
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mag_tracking.errors import OutputError
from mag_tracking.files import output_folder, replace_text
from mag_tracking.results import parquet_table
from mag_tracking.results.columns import (
    FIT_STATE,
    FITS,
    POSES,
    STATE,
    Column,
    axes,
    columns_of,
    pick,
)
from mag_tracking.units import NS

_COMMON = (
    Column('recording', 's', '', 'name of the recording: the stem of its file name'),
    Column('source', 's', '', 'path of the recording'), *pick(POSES, 'stamp_ns'),
    Column('time', 't', '', 'timestamp as UTC time, without a time zone'))
_POSES = (*_COMMON, *pick(POSES, 'track_id'), *STATE,
          Column('covariance', 'C', 'm, m/s', 'covariance of position and velocity'),
          *pick(POSES, 'kind length ambiguous'))

TABLES: dict[str, tuple[Column, ...]] = {
    'tracks': (
        *_COMMON, *pick(POSES, 'track_id'),
        Column('end_ns', 'i', 'ns', 'timestamp of the last pose'),
        *columns_of('i', '', poses='number of published poses'),
        *columns_of('s', '', arrival='most probable arrival direction',
                    kind='most probable kind of vehicle',
                    verdict='ambiguous if the last or the most certain pose is ambiguous, '
                            'otherwise unique',
                    doubts='reasons why poses of the track are ambiguous'),
        *columns_of('f', '', arrival_weight='probability of the arrival direction',
                    kind_weight='probability of the kind',
                    ambiguous_share='fraction of poses that are ambiguous',
                    nis_per_axis='mean normalised innovation squared per axis; about 1 or less '
                                 'for a consistent filter'),
        *columns_of('f', 'm', length='length of the row of dipoles; 0 for a point target',
                    smallest_sd='smallest standard deviation of the horizontal position'),
        *columns_of('f', 'm/s', speed='horizontal speed at the most certain pose'),
        *columns_of('f', 'deg',
                    heading_deg='heading at the most certain pose, anticlockwise from x'),
        *pick(POSES, 'mx my mz'), *columns_of('f', 'A m^2', moment_size='magnitude of the moment'),
        *columns_of('f', 'm/s', smoothed_speed='horizontal speed at the most certain pose of the '
                                               'smoothed track; null if there is no such track'),
        *columns_of('f', 'A m^2', smoothed_moment_size='magnitude of the moment at the most '
                                                       'certain pose of the smoothed track')),
    'poses': (
        *_POSES, *pick(POSES, 'weight kind_weight'),
        *columns_of('s', '', arrival='arrival direction of the published hypothesis'),
        *pick(POSES, 'doubts')),
    'smoothed': _POSES,
    'passes': (
        *_COMMON, Column('number', 'i', '', 'index of the detection in the recording, from 1'),
        *pick(FITS, 'vehicle n_vehicles n_dipoles n_values reason trusted'),
        Column('notes', 's', '', 'remarks, such as excluded measurements and the reason'),
        *pick(FITS, 'normalised_cost explained'), *FIT_STATE,
        *pick(FITS, 'delay_speed sd_delay_speed delay_heading_deg sd_delay_heading_deg')),
    'health': (
        *_COMMON, *columns_of('s', '', sensor='name of the sensor'),
        *columns_of('i', '', accepted='number of readings accepted since the previous row',
                    rejected='number of readings rejected since the previous row',
                    times_relearnt='number of times the background was relearnt'),
        *columns_of('b', '', ready='whether the background has been estimated',
                    stuck='whether the sensor repeats the same value',
                    doubtful='whether the background is doubtful'),
        *axes('background_{}', 'T', 'background, sensor frame'),
        *axes('drift_{}', 'T/s', 'drift of the background, sensor frame'),
        *axes('noise_{}', 'T', 'standard deviation of one reading, sensor frame')),
    'recordings': (
        *_COMMON, *columns_of('s', '', error='reason why processing failed; empty if it succeeded',
                              lost='parts of the recording that could not be read',
                              rejected='number of rejected readings by cause',
                              missing_topics='topics of the network that were not recorded',
                              no_detection_reason='reason why no target was detected; empty if '
                                                  'targets were detected'),
        *columns_of('i', 'ns', end_ns='timestamp of the last frame'),
        *columns_of('i', '', frames='number of frames', tracks='number of tracks',
                    passes='number of rows in `passes`',
                    segments='number of separately tracked segments, each with a target near '
                             'the sensors'),
        *columns_of('i', 'bytes', size='size of the recording')),
}
"""Columns by table. Unknown values are null, and NaN in a covariance."""


MAX_STEM_BYTES = 100
"""Maximum length of the stem of a recording in `NAME` [bytes]."""

_PACKAGE = 'mag_tracking'
_HEAD, _DONE, _WORK, _LOCK = 'archive.json', 'done', 'unfinished', '.lock'


def recording_key(recording: Path) -> str:
    """File name of a recording in the archive, without suffix; the same in every run."""
    path = recording.resolve()
    stem = path.stem.encode(errors='replace')[:MAX_STEM_BYTES].decode(errors='ignore')
    return f'{stem}-{_hash(str(path))}'


def recording_state(recording: Path) -> list[list[Any]]:
    """[name, size in bytes, modification time in ns] of a recording's files, to detect changes."""
    files = sorted(recording.iterdir()) if recording.is_dir() else [recording]
    return [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in files if f.is_file()]


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode(errors='backslashreplace')).hexdigest()[:8]


class ArchiveFolder(AbstractContextManager['ArchiveFolder']):
    """Folder of an archive, locked against other runs until it is closed; a context manager.

    `head` is metadata that must be identical in all runs. Raises OutputError if the folder is
    neither empty nor an archive, has other metadata or another table version, or is locked.
    """

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        self.path = output_folder(folder)
        if not (self.path / _HEAD).exists() and any(p.name != _LOCK for p in self.path.iterdir()):
            raise OutputError(f'{self.path} is not empty and is not an archive; choose another '
                              'folder')
        self._lock = self._acquire_lock()
        try:
            self._check_head({'schema': parquet_table.VERSION, **head})
            for name in (_DONE, _WORK):
                output_folder(self.path / name)
            # One pass over all tables takes less time than a search for those of each recording.
            self._damaged = {table.stem: table for table in self.path.glob('*/date=*/*.parquet')
                             if not parquet_table.is_complete(table)}
        except OSError as error:
            self.close()
            raise OutputError(f'cannot read {self.path}: {error.strerror}') from error
        except OutputError:
            self.close()
            raise

    def _acquire_lock(self) -> int:
        import fcntl

        path = self.path / _LOCK
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OutputError(f'cannot write to {self.path}: {error.strerror}') from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            raise OutputError(f'another run is writing to {self.path}: wait until it has finished, '
                              'or choose another folder') from error
        return lock

    def close(self) -> None:
        """Release the lock."""
        os.close(self._lock)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_head(self, head: dict[str, Any]) -> None:
        path = self.path / _HEAD
        if not path.exists():
            replace_text(path, json.dumps(head, indent=1, sort_keys=True) + '\n')
            return
        previous_head = _read_json(path)
        if previous_head.get('schema') != parquet_table.VERSION:
            raise OutputError(f'{self.path} has tables of version {previous_head.get("schema")}; '
                              f'this program writes version {parquet_table.VERSION}. Choose '
                              'another folder')
        differing_keys = sorted(key for key in {*head, *previous_head}
                                if json.dumps(head.get(key), sort_keys=True)
                                != json.dumps(previous_head.get(key), sort_keys=True))
        if differing_keys:
            raise OutputError(f'{self.path} was created with other values of '
                              f'{", ".join(differing_keys)}: the new rows would not be comparable '
                              'with the existing rows. Choose another folder')

    def done(self, recording: Path) -> dict[str, Any] | None:
        """Summary of a recording, or None if it was not processed or has changed since; raises
        OutputError if the summary or a table is damaged."""
        name = recording_key(recording)
        path = self.path / _DONE / f'{name}.json'
        if not path.exists():
            return None
        if name in self._damaged:
            raise OutputError(f'{self._damaged[name]} is damaged')
        summary = _read_summary(path)
        try:
            return summary if summary.get('state') == recording_state(recording) else None
        except OSError:
            return None

    def begin(self, recording: Path, state: list[list[Any]]) -> Path:
        """Remove outdated results of a recording, and create the folder for its partial results."""
        name, work = recording_key(recording), self.path / _WORK
        identity = json.dumps([parquet_table.VERSION, version(_PACKAGE), state])
        folder = work / f'{name}.{_hash(identity)}'
        try:
            (self.path / _DONE / f'{name}.json').unlink(missing_ok=True)
            for path in self.path.glob(f'*/date=*/{glob.escape(name)}.parquet'):
                path.unlink()
            for path in work.glob(f'*{glob.escape(name)}.*'):
                if path != folder:
                    _remove(path)
        except OSError as error:
            raise OutputError(f'cannot write to {self.path}: {error.strerror}') from error
        return output_folder(folder)

    def complete(self, recording: Path, work: Path, state: list[list[Any]],
                 summary: Mapping[str, Any]) -> None:
        """Mark a recording, whose tables are written, as processed, and remove `work`; `state` is
        that of the beginning, so that a recording that has changed meanwhile is processed again."""
        replace_text(self.path / _DONE / f'{recording_key(recording)}.json',
                     json.dumps({**summary, 'state': state}, indent=1) + '\n')
        _remove(work)

    def write_recordings(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write the table `recordings` atomically."""
        path = self.path / 'recordings.parquet'
        with parquet_table.TableWriter(path, TABLES['recordings']) as table:
            for row in rows:
                table.add(row)

    def summaries(self, report: Callable[[str], object]) -> Iterator[dict[str, Any]]:
        """Summaries of all processed recordings; damaged ones are reported and left out."""
        for path in sorted((self.path / _DONE).glob('*.json')):
            try:
                yield _read_summary(path)
            except OutputError as error:
                report(f'{error}; its recording is missing in recordings.parquet until it is '
                       'tracked again')


def _remove(folder: Path) -> None:
    """Rename a folder, then delete it, so that an interruption leaves no partial folder."""
    renamed = folder.with_name(f'.{secrets.token_hex(8)}.{folder.name}')
    folder.rename(renamed)
    shutil.rmtree(renamed, ignore_errors=True)


def join_tables(parts: Iterable[Path], shifts: Iterable[int], table: str, folder: Path,
                name: str) -> int:
    """Concatenate the tables of a recording's segments, write a file per day, and count the rows.

    Each of `shifts` is added to the column `track_id` of its part (chronological).
    """
    pa = parquet_table.import_pyarrow()
    n, day_ns = 0, pa.scalar(86_400 * NS)
    with ExitStack() as files:
        days: dict[int, parquet_table.TableWriter] = {}
        for path, shift in zip(parts, shifts, strict=True):
            rows = pa.parquet.read_table(path)
            n += len(rows)
            if shift:
                index = rows.schema.get_field_index('track_id')
                rows = rows.set_column(index, rows.schema.field(index),
                                       pa.compute.add(rows['track_id'], shift))
            days_of_rows = pa.compute.divide(rows['stamp_ns'], day_ns)
            for day in sorted(pa.compute.unique(days_of_rows).to_pylist()):
                if day not in days:
                    date = datetime.date(1970, 1, 1) + datetime.timedelta(days=day)
                    days[day] = files.enter_context(parquet_table.TableWriter(
                        folder / table / f'date={date}' / f'{name}.parquet', TABLES[table]))
                days[day].add_table(rows.filter(pa.compute.equal(days_of_rows, day)))
    return n


def common_columns(recording: Path, stamp_ns: int | None) -> dict[str, Any]:
    """Columns that the rows of all tables have in common."""
    return {'recording': recording.stem, 'source': str(recording), 'stamp_ns': stamp_ns,
            'time': stamp_ns}


def _read_summary(path: Path) -> dict[str, Any]:
    summary = _read_json(path)
    try:
        parquet_table.check_row(summary, TABLES['recordings'])
        if summary['size'] is None:
            raise ValueError('size is missing')
    except ValueError as error:
        raise OutputError(f'{path} is damaged: {error}') from error
    return summary


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise OutputError(f'cannot read {path}: {error}') from error
    if not isinstance(content, dict):
        raise OutputError(f'{path} is not a valid file of an archive')
    return content
