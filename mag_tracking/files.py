"""Files: valid paths, creation without following links, JSON without NaN, and YAML with limits."""

import json
import math
import os
import secrets
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from os import PathLike, fspath
from pathlib import Path
from reprlib import Repr
from typing import Any, BinaryIO, TextIO

import yaml

from mag_tracking.errors import MagTrackingError, OutputError

MAX_NODES = 1_000_000
"""Maximum number of keys, values, lists and mappings of a YAML file with aliases expanded."""
MAX_ENTRIES = 1000
"""Maximum number of entries of a mapping. The parser needs half a minute for 10,000 sensors."""
MAX_BYTES = 2_000_000
"""Maximum size of a YAML file [bytes]; a thousand sensors with all calibrations have 1.1 MB."""
MAX_DEPTH = 64
"""Maximum depth of lists and mappings in a YAML file after expansion of aliases."""
MAX_BITS = 14_000
"""Maximum size of an integer [bits]. Python does not format more than 4300 decimal digits."""
_REPR = Repr()
_REPR.maxlevel, _REPR.maxstring, _REPR.maxother, _REPR.maxlong = 3, 200, 200, 200
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = 20


def checked_path(path: str | PathLike[str], error: type[MagTrackingError]) -> Path:
    """Convert a path to a `Path`; raises `error` if it contains a NUL character."""
    if '\0' in fspath(path):
        raise error(f'{fspath(path)!r} is not a valid path: it contains a NUL character')
    return Path(path)


def output_folder(path: str | PathLike[str]) -> Path:
    """Create a folder for results if it does not exist; raises OutputError if this fails."""
    folder = checked_path(path, OutputError)
    with output_errors(f'to {folder}'):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


@contextmanager
def output_errors(place: str | Path) -> Iterator[None]:
    """Convert an OSError to an OutputError that names `place`, a path or `to FOLDER`."""
    try:
        yield
    except OSError as error:
        raise OutputError(f'cannot write {place}: {error.strerror}') from error


def new_text_file(path: str | PathLike[str], newline: str | None = None) -> TextIO:
    """Create an empty UTF-8 file and open it for writing, in place of any file or link.

    The target of a link is not modified. Unpaired surrogates, for example from file names that are
    not UTF-8, are written as escape sequences. Raises OSError if the file cannot be created,
    OutputError if the path is invalid.
    """
    return open(_unlinked_path(path), 'x', newline=newline, encoding='utf-8',
                errors='backslashreplace')


def new_binary_file(path: str | PathLike[str]) -> BinaryIO:
    """Create an empty binary file and open it for writing, as `new_text_file`."""
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


class _UniqueKeyLoader(yaml.SafeLoader):
    """Safe loader that rejects duplicate keys, and content that exceeds the limits."""

    def get_single_node(self) -> yaml.Node | None:
        """Return the root node after checking its size and depth; None for an empty document."""
        node = super().get_single_node()
        if node is not None:
            _check_size(node)
        return node

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node; raises YAMLError if its mapping exceeds `MAX_ENTRIES`."""
        if isinstance(parent, yaml.MappingNode) and len(parent.value) >= MAX_ENTRIES:
            raise yaml.YAMLError(f'more than {MAX_ENTRIES} entries in the mapping that begins in '
                                 f'line {parent.start_mark.line + 1}')
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == 'tag:yaml.org,2002:merge':
                continue
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, Hashable):
                raise yaml.YAMLError(f'{short_repr(key)} is not a valid key (line {line})')
            if key in seen:
                raise yaml.YAMLError(f'duplicate key {key} (line {line})')
            seen.add(key)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """Convert a node to an integer; raises YAMLError if it exceeds `MAX_BITS`."""
        value = super().construct_yaml_int(node)
        if value.bit_length() > MAX_BITS:
            raise yaml.YAMLError(f'an integer of {value.bit_length()} bits exceeds the maximum of '
                                 f'{MAX_BITS} bits (line {node.start_mark.line + 1})')
        return value


_UniqueKeyLoader.add_constructor('tag:yaml.org,2002:int', _UniqueKeyLoader.construct_yaml_int)


def _check_size(root: yaml.Node) -> None:
    """Raise YAMLError if a file is too large, too deep or infinite once aliases are expanded; here,
    a node with several aliases is visited once."""
    # {id of a node: (nodes, depth)}; None while its children are being counted.
    sizes: dict[int, tuple[int, int] | None] = {}
    stack = [root]
    while stack:
        node, line = stack[-1], stack[-1].start_mark.line + 1
        if sizes.get(id(node)) is not None:
            stack.pop()
        elif id(node) not in sizes:
            sizes[id(node)] = None
            for child in _children(node):
                if id(child) not in sizes:
                    stack.append(child)
                elif sizes[id(child)] is None:
                    raise yaml.YAMLError(f'an alias contains itself (line {line})')
        else:
            child_sizes = [size for c in _children(node) if (size := sizes[id(c)]) is not None]
            nodes = 1 + sum(n for n, _ in child_sizes)
            depth = 1 + max((d for _, d in child_sizes), default=0)
            sizes[id(node)] = nodes, depth
            if nodes > MAX_NODES:
                raise yaml.YAMLError(f'aliases expand to more than {MAX_NODES} values '
                                     f'(line {line})')
            if depth > MAX_DEPTH:
                raise yaml.YAMLError(f'nested too deeply: more than {MAX_DEPTH} levels '
                                     f'(line {line})')


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [child for pair in node.value for child in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def read_yaml(path: str | PathLike[str], error: type[MagTrackingError]) -> Any:
    """Read a YAML file.

    Raises `error`, with the name of the file, if it cannot be read, is not valid YAML, has
    duplicate keys, or is too large or too deep.
    """
    path = checked_path(path, error)
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise error(f'{path} has {size / 1e6:.1f} MB; the maximum of a YAML file is '
                        f'{MAX_BYTES / 1e6:g} MB')
        with open(path, encoding='utf-8') as stream:
            return parse_yaml(stream, str(path), error)
    except OSError as problem:
        raise error(f'cannot read {path}: {problem.strerror}') from problem


def parse_yaml(text: str | TextIO, name: str, error: type[MagTrackingError]) -> Any:
    """Parse YAML; raises `error`, as `read_yaml`, with a message that begins with `name`."""
    try:
        return yaml.load(text, Loader=_UniqueKeyLoader)
    # ValueError: an invalid date or number (2001-13-45), or bytes that are not UTF-8.
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f'{name} is not valid YAML: {problem}') from problem
    except RecursionError as problem:
        raise error(f'{name} is nested too deeply') from problem


def is_utf8_encodable(value: str) -> bool:
    """Whether a string can be encoded as UTF-8: it has no unpaired surrogate."""
    return not any('\ud800' <= c <= '\udfff' for c in value)


def short_repr(value: object) -> str:
    """`repr` of a value for an error message, shortened if it is long."""
    return _REPR.repr(value)
