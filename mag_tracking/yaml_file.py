"""Reading YAML that people write by hand."""

from collections.abc import Hashable
from os import PathLike
from reprlib import Repr
from typing import Any, TextIO

import yaml

from mag_tracking.errors import MagTrackingError
from mag_tracking.files import checked_path

MAX_NODES = 1_000_000
"""Keys, values, lists and mappings of a file, aliases expanded."""
DEEPEST = 64
"""Levels of lists and mappings, aliases expanded."""
MAX_BITS = 14_000
"""Size of an integer: Python converts none above 4300 decimal digits to text."""


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML lets a key appear twice and keeps the last: a sensor would vanish without a word."""

    def get_single_node(self) -> yaml.Node | None:
        """The root, once its size is known to be bounded."""
        node = super().get_single_node()
        if node is not None:
            _check_size(node)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False
                          ) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == 'tag:yaml.org,2002:merge':
                continue
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, Hashable):
                raise yaml.YAMLError(f'{shown(key)} is no name (line {line})')
            if key in seen:
                raise yaml.YAMLError(f'{key} is there twice (line {line})')
            seen.add(key)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """An integer that can be written in a message."""
        value = super().construct_yaml_int(node)
        if value.bit_length() > MAX_BITS:
            raise yaml.YAMLError(f'an integer of {value.bit_length()} bits is more than '
                                 f'{MAX_BITS} (line {node.start_mark.line + 1})')
        return value


_UniqueKeyLoader.add_constructor('tag:yaml.org,2002:int', _UniqueKeyLoader.construct_yaml_int)


def _check_size(root: yaml.Node) -> None:
    """Raise YAMLError where aliases make a file large, deep or endless.

    A node that several aliases refer to is one object, and is counted once: nothing is expanded.
    """
    # {id of a node: (nodes, depth)}; None while what it holds is counted.
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
                    raise yaml.YAMLError(f'an alias holds itself (line {line})')
        else:
            below = [size for c in _children(node) if (size := sizes[id(c)]) is not None]
            nodes = 1 + sum(n for n, _ in below)
            depth = 1 + max((d for _, d in below), default=0)
            sizes[id(node)] = nodes, depth
            if nodes > MAX_NODES:
                raise yaml.YAMLError(f'aliases expand to more than {MAX_NODES} values '
                                     f'(line {line})')
            if depth > DEEPEST:
                raise yaml.YAMLError(f'nested too deeply: more than {DEEPEST} levels '
                                     f'(line {line})')


def _children(node: yaml.Node) -> list[yaml.Node]:
    """The nodes that a node holds, keys included."""
    if isinstance(node, yaml.MappingNode):
        return [child for pair in node.value for child in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def read_yaml(path: str | PathLike[str], error: type[MagTrackingError]) -> Any:
    """The content of a YAML file.

    Raises `error` with a message that names the file: where
    it cannot be read, is no YAML, says something twice, or is too large or too deep.
    """
    path = checked_path(path, error)
    try:
        with open(path, encoding='utf-8') as stream:
            return parse_yaml(stream, str(path), error)
    except OSError as problem:
        raise error(f'cannot read {path}: {problem.strerror}') from problem


def parse_yaml(text: str | TextIO, name: str, error: type[MagTrackingError]) -> Any:
    """The content of YAML text, or of a stream of it.

    Raises `error` as `read_yaml` does, with a message that begins with `name`.
    """
    try:
        return yaml.load(text, Loader=_UniqueKeyLoader)
    # ValueError: a date or a number that is none (2001-13-45); also bytes that are no text.
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f'{name} is not YAML as it should be: {problem}') from problem
    except RecursionError as problem:
        raise error(f'{name} is nested too deeply') from problem


def is_text(value: str) -> bool:
    """Whether a string can be written as UTF-8: lone surrogates, as "\\ud800" in YAML, cannot."""
    return not any('\ud800' <= c <= '\udfff' for c in value)


class _ShortRepr(Repr):
    """`repr` of bounded length."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxstring, self.maxother, self.maxlong = 3, 200, 200, 200
        self.maxlist = self.maxtuple = self.maxdict = 20


def shown(value: object) -> str:
    """`repr` of a value for an error message, shortened where it is long."""
    return _ShortRepr().repr(value)
