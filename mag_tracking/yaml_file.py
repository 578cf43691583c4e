"""Reading YAML that people write by hand."""

from collections.abc import Hashable
from os import PathLike
from typing import Any

import yaml


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML lets a key appear twice and keeps the last: a sensor would vanish without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False
                          ) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == 'tag:yaml.org,2002:merge':
                continue
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, Hashable):
                raise yaml.YAMLError(f'{key!r} is no name (line {line})')
            if key in seen:
                raise yaml.YAMLError(f'{key} is there twice (line {line})')
            seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(path: str | PathLike[str], error: type[Exception]) -> Any:
    """The content of a YAML file.

    Raises `error`, an exception class, with a message that names the file: where
    it cannot be read, is no YAML, or says something twice.
    """
    try:
        with open(path, encoding='utf-8') as stream:
            return yaml.load(stream, Loader=_UniqueKeyLoader)
    except OSError as problem:
        raise error(f'cannot read {path}: {problem.strerror}') from problem
    # ValueError: a date or a number that is none (2001-13-45); also bytes that are no text.
    except (yaml.YAMLError, ValueError) as problem:
        raise error(f'{path} is not YAML as it should be: {problem}') from problem
    except RecursionError as problem:
        raise error(f'{path} is nested too deeply') from problem
