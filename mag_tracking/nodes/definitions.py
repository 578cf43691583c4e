"""Definitions of message types, for the schemas of recordings."""

import functools
import os
import sys
from pathlib import Path

from mag_tracking.errors import RecordingError
from mag_tracking.messages.types import definition, referenced_types


@functools.cache
def definition_of(type_name: str) -> str | None:
    """Definition of a type with those of all contained types, in the format of a `ros2msg` schema.

    Parameters
    ----------
    type_name : str
        For example `std_msgs/msg/Header`.

    Returns
    -------
    str or None
        None if the .msg file of a type is not installed.
    """
    try:
        return definition(type_name)
    except RecordingError:
        pass
    seen, queue, text = [type_name], [type_name], ''
    while queue:
        name = queue.pop(0)
        own = _own_text(name)
        if own is None:
            return None
        package, _, leaf = name.split('/')
        text += own if not text else f'{"=" * 80}\nMSG: {package}/{leaf}\n{own}'
        new = [t for t in referenced_types(own, package) if t not in seen]
        seen += new
        queue += new
    return text


def _own_text(type_name: str) -> str | None:
    """Text of the .msg file of a type, or None."""
    package, kind, leaf = type_name.split('/')
    # The wheels leave AMENT_PREFIX_PATH unset and install below sys.prefix.
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    for prefix in (*prefixes, sys.prefix):
        file = Path(prefix) / 'share' / package / kind / f'{leaf}.msg'
        if file.is_file():
            text = file.read_text(encoding='utf-8', errors='replace')
            return text if text.endswith('\n') else f'{text}\n'
    return None
