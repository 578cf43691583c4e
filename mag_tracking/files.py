"""Path validation, creation of result files without following links, and JSON without NaN."""

import json
import math
import os
import secrets
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from mag_tracking.errors import MagTrackingError, OutputError


def checked_path(path: str | PathLike[str], error: type[MagTrackingError]) -> Path:
    """Convert a path to a `Path`; raises `error` if it contains a NUL character."""
    if '\0' in fspath(path):
        raise error(f'{fspath(path)!r} is not a valid path: it contains a NUL character')
    return Path(path)


def output_folder(path: str | PathLike[str]) -> Path:
    """Create a folder for results if it does not exist; raises OutputError if it cannot be
    created."""
    folder = checked_path(path, OutputError)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror}') from error
    return folder


def new_text_file(path: str | PathLike[str], newline: str | None = None) -> TextIO:
    """Create an empty UTF-8 file and open it for writing; `newline` as for `open`.

    An existing file or link with this name is removed first; the target of a link is not modified.
    Unpaired surrogates, for example from file names that are not UTF-8, are written as escape
    sequences. Raises OSError if the file cannot be created, OutputError if the path is invalid.
    """
    return open(_unlinked_path(path), 'x', newline=newline, encoding='utf-8',
                errors='backslashreplace')


def new_binary_file(path: str | PathLike[str]) -> BinaryIO:
    """Create an empty binary file and open it for writing, with the errors of `new_text_file`.

    An existing file or link with this name is removed first; the target of a link is not modified.
    """
    return open(_unlinked_path(path), 'xb')


def replace_text(path: str | PathLike[str], text: str) -> None:
    """Write a UTF-8 file atomically; raises OutputError if it cannot be written.

    The text is written to a temporary file with a random name, which then replaces `path`. Links
    are not followed, neither at `path` nor at the temporary name.
    """
    path = checked_path(path, OutputError)
    temporary = path.parent / f'.{path.name}.{secrets.token_hex(8)}.part'
    try:
        with open(temporary, 'x', encoding='utf-8', errors='backslashreplace') as stream:
            stream.write(text)
            stream.flush()
            # Without fsync, a power failure could leave an empty file in place of the old one.
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f'cannot write {path}: {error.strerror}') from error


def json_text(value: Any) -> str:
    """Serialise nested dicts and lists as JSON, with null for NaN and infinity."""
    return json.dumps(_without_nan(value), allow_nan=False)


def write_json(path: str | PathLike[str], value: Any) -> None:
    """Write `json_text` with indentation to a new file, with the errors of `new_text_file`."""
    with new_text_file(path) as stream:
        json.dump(_without_nan(value), stream, indent=1, allow_nan=False)
        stream.write('\n')


def _without_nan(value: Any) -> Any:
    """Replace NaN and infinity by None in a copy of nested dicts and lists; tuples become lists."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _unlinked_path(path: str | PathLike[str]) -> Path:
    """Return `path` after removing any file or link there, so that exclusive creation succeeds."""
    path = checked_path(path, OutputError)
    path.unlink(missing_ok=True)
    return path
