"""The dataset of an archive: tables in Parquet files, one for each recording and day.

    DIR/archive.json                    schema, network and settings
    DIR/TABLE/date=2026-03-01/NAME.parquet
    DIR/done/NAME.json                  written last: the recording is complete
    DIR/unfinished/NAME.STATE/          what the next run continues with

NAME is the stem of the recording and a hash of its path, STATE a hash of what its files are.
pyarrow is imported when a table is written or read.
"""

import datetime
import glob
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mag_tracking.errors import OutputError
from mag_tracking.files import output_folder, replace_text
from mag_tracking.recording.archive_tables import TABLES
from mag_tracking.recording.parquet_table import VERSION, TableWriter, import_pyarrow
from mag_tracking.units import NS

if TYPE_CHECKING:
    pass

MAX_BYTES = 100
"""Of the stem of a recording, in the names of its files."""

_PACKAGE = 'mag_tracking'
_HEAD, _DONE, _WORK, _LOCK = 'archive.json', 'done', 'unfinished', '.lock'


def name_of(recording: Path) -> str:
    """What the files of a recording are named: the same in every run."""
    path = recording.resolve()
    stem = path.stem.encode(errors='replace')[:MAX_BYTES].decode(errors='ignore')
    return f'{stem}-{_hash(str(path))}'


def state_of(recording: Path) -> list[list[Any]]:
    """[[name, size, time of change], ...] of the files of a recording: equal while it is the same.

    Raises OSError.
    """
    files = sorted(recording.iterdir()) if recording.is_dir() else [recording]
    return [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in files if f.is_file()]


def _hash(text: str) -> str:
    """Eight digits that hardly any two texts share."""
    return hashlib.sha256(text.encode(errors='backslashreplace')).hexdigest()[:8]


class ArchiveFolder:
    """The folder of an archive, for the one process that directs it."""

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        """Open it, or make it; `head` is what all runs into it have to have in common.

        Raises OutputError where it belongs to other settings, to another version of the tables, or
        to a run that is still going on.
        """
        self.path = output_folder(folder)
        if not (self.path / _HEAD).exists() and any(p.name != _LOCK for p in self.path.iterdir()):
            raise OutputError(f'{self.path} is not empty and is no archive; take another folder')
        self._lock = self._locked()
        try:
            self._check_head({'schema': VERSION, **head})
            for name in (_DONE, _WORK):
                output_folder(self.path / name)
        except OutputError:
            self.close()
            raise

    def _locked(self) -> int:
        """Descriptor of the lock that only one run can have; raises OutputError."""
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
            raise OutputError(f'another archive is being written into {self.path}: wait until it '
                              'is done, or take another folder') from error
        return lock

    def close(self) -> None:
        """Let others write into it."""
        os.close(self._lock)

    def __enter__(self) -> 'ArchiveFolder':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_head(self, head: dict[str, Any]) -> None:
        """Compare with those before, or write it; raises OutputError."""
        path = self.path / _HEAD
        if not path.exists():
            replace_text(path, json.dumps(head, indent=1, sort_keys=True) + '\n')
            return
        before = _read_json(path)
        if before.get('schema') != VERSION:
            raise OutputError(f'{self.path} has tables of version {before.get("schema")}; this '
                              f'program writes version {VERSION}. Take another folder')
        differs = sorted(key for key in {*head, *before}
                         if json.dumps(head.get(key), sort_keys=True)
                         != json.dumps(before.get(key), sort_keys=True))
        if differs:
            raise OutputError(f'{self.path} was begun with another {", another ".join(differs)}: '
                              'its rows would not be comparable. Take another folder')

    def done(self, recording: Path) -> dict[str, Any] | None:
        """What is known of a recording that is complete and has not changed since, or None."""
        path = self.path / _DONE / f'{name_of(recording)}.json'
        if not path.exists():
            return None
        known = _read_json(path)
        return known if known.get('state') == state_of(recording) else None

    def begin(self, recording: Path, state: list[list[Any]]) -> Path:
        """The folder of what is not complete; results of another state of it are removed.

        Raises OutputError.
        """
        name, work = name_of(recording), self.path / _WORK
        own = work / f'{name}.{_hash(json.dumps([VERSION, version(_PACKAGE), state]))}'
        try:
            (self.path / _DONE / f'{name}.json').unlink(missing_ok=True)
            for path in self.path.glob(f'*/date=*/{glob.escape(name)}.parquet'):
                path.unlink()
            for path in work.glob(f'*{glob.escape(name)}.*'):
                if path != own:
                    _remove(path)
        except OSError as error:
            raise OutputError(f'cannot write to {self.path}: {error.strerror}') from error
        return output_folder(own)

    def complete(self, recording: Path, work: Path, state: list[list[Any]],
                 known: Mapping[str, Any]) -> None:
        """All tables of a recording are written: note what is `known` of it.

        `state` is that of the time when it was begun: had it changed meanwhile, the next run would
        track it again.
        """
        replace_text(self.path / _DONE / f'{name_of(recording)}.json',
                     json.dumps({**known, 'state': state}, indent=1) + '\n')
        _remove(work)

    def write_recordings(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """The table `recordings`, as a whole."""
        with TableWriter(self.path / 'recordings.parquet', TABLES['recordings']) as table:
            for row in rows:
                table.add(row)

    def known(self) -> list[dict[str, Any]]:
        """What is known of each recording that is complete, also of earlier runs."""
        return [_read_json(path) for path in sorted((self.path / _DONE).glob('*.json'))]


def _remove(folder: Path) -> None:
    """Remove a folder; a part of it is never found under its name."""
    away = folder.with_name(f'.{secrets.token_hex(8)}.{folder.name}')
    folder.rename(away)
    shutil.rmtree(away, ignore_errors=True)


def join_tables(parts: Iterable[Path], shifts: Iterable[int], table: str, folder: Path,
                name: str) -> int:
    """Put the tables of the stretches of a recording together, one file for each day.

    Parameters
    ----------
    parts, shifts
        Files of the same table, in order, and what is added to the `track_id`s of each.
    table, folder, name
        Written is `folder`/`table`/date=.../`name`.parquet.

    Returns
    -------
    int
        Number of rows. Raises OutputError.
    """
    pa = import_pyarrow()
    n, a_day = 0, pa.scalar(86_400 * NS)
    with ExitStack() as files:
        days: dict[int, TableWriter] = {}
        for path, shift in zip(parts, shifts, strict=True):
            rows = pa.parquet.read_table(path)
            n += len(rows)
            if shift:
                place = rows.schema.get_field_index('track_id')
                rows = rows.set_column(place, rows.schema.field(place),
                                       pa.compute.add(rows['track_id'], shift))
            day_of = pa.compute.divide(rows['stamp_ns'], a_day)
            for day in sorted(pa.compute.unique(day_of).to_pylist()):
                if day not in days:
                    date = datetime.date(1970, 1, 1) + datetime.timedelta(days=day)
                    days[day] = files.enter_context(TableWriter(
                        folder / table / f'date={date}' / f'{name}.parquet', TABLES[table]))
                days[day].add_table(rows.filter(pa.compute.equal(day_of, day)))
    return n


def stamped(recording: Path, stamp_ns: int | None) -> dict[str, Any]:
    """The columns that every row begins with."""
    return {'recording': recording.stem, 'source': str(recording), 'stamp_ns': stamp_ns,
            'time': stamp_ns}


def _read_json(path: Path) -> dict[str, Any]:
    """Its content; raises OutputError."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise OutputError(f'cannot read {path}: {error}') from error
    if not isinstance(content, dict):
        raise OutputError(f'{path} is not of an archive')
    return content
