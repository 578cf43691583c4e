"""Definitions of message types, for the schemas of recordings."""

import functools
import os
import sys
from pathlib import Path

from mag_tracking.errors import RecordingError
from mag_tracking.messages.types import definition, referenced_types


@functools.cache
def definition_of(type_name: str) -> str | None:
    """Definition of a message type and all nested types, in the format of a `ros2msg` schema.

    None if the .msg file of a type is not installed.
    """
    try:
        return definition(type_name)
    except RecordingError:
        pass
    known, queue, schema = [type_name], [type_name], ''
    while queue:
        name = queue.pop(0)
        content = _file_content(name)
        if content is None:
            return None
        package, _, leaf = name.split('/')
        schema += content if not schema else f'{"=" * 80}\nMSG: {package}/{leaf}\n{content}'
        new_types = [t for t in referenced_types(content, package) if t not in known]
        known += new_types
        queue += new_types
    return schema


def _file_content(type_name: str) -> str | None:
    """Content of the .msg file of a type; None if the file is not installed."""
    package, kind, leaf = type_name.split('/')
    # ROS from PyPI leaves AMENT_PREFIX_PATH unset and is installed below sys.prefix.
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    for prefix in (*prefixes, sys.prefix):
        file = Path(prefix) / 'share' / package / kind / f'{leaf}.msg'
        if file.is_file():
            text = file.read_text(encoding='utf-8', errors='replace')
            return text if text.endswith('\n') else f'{text}\n'
    return None
