"""Validated paths, and result files created from scratch, never written through a link."""

import os
import secrets
from os import PathLike, fspath
from pathlib import Path
from typing import BinaryIO, TextIO

from mag_tracking.errors import MagTrackingError, OutputError


def checked_path(path: str | PathLike[str], error: type[MagTrackingError]) -> Path:
    """`path` as a `Path`; raises `error` where no file can have that name."""
    if '\0' in fspath(path):
        raise error(f'{fspath(path)!r} is not a valid path: it contains a NUL character')
    return Path(path)


def output_folder(path: str | PathLike[str]) -> Path:
    """A folder for results, made if it does not exist; raises OutputError."""
    folder = checked_path(path, OutputError)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror}') from error
    return folder


def new_text_file(path: str | PathLike[str], newline: str | None = None) -> TextIO:
    """A new, empty UTF-8 file, open for writing.

    A file or link of that name is removed first; the target of a link stays untouched. Lone
    surrogates, such as those of a file name that is not UTF-8, are written as `\\udcff`.

    Raises OSError, and OutputError where no file can have that name.
    """
    return open(_free(path), 'x', newline=newline, encoding='utf-8', errors='backslashreplace')


def new_binary_file(path: str | PathLike[str]) -> BinaryIO:
    """A new, empty file for bytes, created in the same way as a text file."""
    return open(_free(path), 'xb')


def replace_text(path: str | PathLike[str], text: str) -> None:
    """Write a UTF-8 file as a whole: until it is complete, what was there stays.

    It is written under a fresh name and moved into place, so that no link is written through,
    neither one of that name nor one that was planted under the temporary name.

    Raises OutputError.
    """
    path = checked_path(path, OutputError)
    draft = path.parent / f'.{path.name}.{secrets.token_hex(8)}.part'
    try:
        with open(draft, 'x', encoding='utf-8', errors='backslashreplace') as stream:
            stream.write(text)
            stream.flush()
            # Else a power cut might leave an empty file in the place of the old one.
            os.fsync(stream.fileno())
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise OutputError(f'cannot write {path}: {error.strerror}') from error


def _free(path: str | PathLike[str]) -> Path:
    """The path, unlinked: the exclusive creation that follows would fail on a link."""
    path = checked_path(path, OutputError)
    path.unlink(missing_ok=True)
    return path
