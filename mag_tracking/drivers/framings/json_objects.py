"""Framing of JSON objects, one a line or one a message."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from mag_tracking.drivers.framings.fields import (
    ACCELERATION,
    FIELD,
    OF_THE_FRAME,
    FieldLayout,
    Rejected,
    axis_value,
    sensor_name,
    sequence_value,
    ticks_value,
)
from mag_tracking.drivers.framings.text import Lines
from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

_Keys: TypeAlias = tuple[tuple[str, int | None], ...]
_Converter: TypeAlias = Callable[[object, str], object]

@dataclass(frozen=True)
class JsonSettings:
    """Settings of the framing of JSON objects; a path is keys with dots between, `a.b.0`."""

    sensor: str = param('', "Path of the sensor's name (a text or an integer); empty = none.")
    ticks: str = param('', "Path of the device's clock; empty = none.")
    sequence: str = param('', "Path of the device's count of readings; empty = none.")
    field: tuple[str, ...] = param(
        (), 'Paths of the three axes of the field (empty = that axis is not there), or the path '
        'of a list of three.')
    acceleration: tuple[str, ...] = param((), 'As field, of the acceleration.')
    end: str = param('\\n', 'Ends a line; a carriage return before it is dropped.')
    max_length: int = param(
        4096, 'Longest line or message, without its end.', 'bytes', (2, 1 << 20))


class JsonFraming:
    """Readings from JSON objects, one reading an object.

    An axis is null or NaN where it is missing; a path that leads nowhere is a
    rejection. An object of several lines is only read where the data are `final`
    and hold nothing else; otherwise its lines are read one by one.

    Source: RFC 8259; NaN and Infinity, which it does not have, are read as Python,
    JavaScript libraries and many devices write them.
    """

    SETTINGS = JsonSettings

    def __init__(self, settings: JsonSettings) -> None:
        """Raises SettingsError."""
        self._lines = Lines(settings.end, settings.max_length)
        self._decode = json.JSONDecoder(object_pairs_hook=_object).decode
        self._lists: list[tuple[str, _Keys]] = []
        self._values: list[tuple[str, _Keys, _Converter]] = []
        names: list[str] = []
        for name in OF_THE_FRAME:
            if path := getattr(settings, name):
                names.append(name)
                self._values.append((path, _keys(name, path), _CONVERTERS[name]))
        for name, axes in (('field', FIELD), ('acceleration', ACCELERATION)):
            for axis, path in zip(axes, self._axes(name, getattr(settings, name)), strict=True):
                if path:
                    names.append(axis)
                    self._values.append((path, _keys(name, path), _axis))
        if not self._values or names[-1] in OF_THE_FRAME:
            raise SettingsError('field: neither the field nor the acceleration has a path')
        self._layout = FieldLayout(names)

    def _axes(self, name: str, paths: tuple[str, ...]) -> tuple[str, ...]:
        """The paths of three axes."""
        if len(paths) == 1 and paths[0]:
            self._lists.append((paths[0], _keys(name, paths[0])))
            return tuple(f'{paths[0]}.{i}' for i in range(3))
        if any(paths) and len(paths) != 3:
            raise SettingsError(f'{name}: expected the paths of three axes, or of one list, got '
                                f'{list(paths)}')
        return paths if any(paths) else ('', '', '')

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """All readings in `data`; see `Framing.parse`."""
        if final and self._is_one(data):
            return self._lines.read([data], len(data), self._read)
        return self._lines.parse(data, final, self._read)

    def _is_one(self, data: bytes) -> bool:
        """Whether all of a message is one piece of JSON, of several lines perhaps."""
        if self._lines.end not in data.strip() or len(data) > self._lines.max_length:
            return False
        try:
            self._json(data)
        except Rejected:
            return False
        return True

    def _json(self, line: bytes) -> Any:
        """What a line says, or Rejected."""
        try:
            return self._decode(line.decode())
        except RecursionError:
            raise Rejected('that are nested too deeply') from None
        except Rejected:
            raise
        except ValueError:
            # Also an integer of more digits than Python cares to read.
            raise Rejected('that are no JSON') from None

    def _read(self, line: bytes) -> list[Reading]:
        """The reading of one object, or Rejected."""
        content = self._json(line)
        if not isinstance(content, dict):
            raise Rejected('that are no JSON object')
        for path, keys in self._lists:
            value = _at(content, path, keys)
            if not isinstance(value, list) or len(value) != 3:
                raise Rejected(f'whose {path} is no list of three')
        return self._layout.readings([convert(_at(content, path, keys), path)
                                      for path, keys, convert in self._values])


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object as a dict."""
    content = dict(pairs)
    if len(content) != len(pairs):
        raise Rejected('with a key twice')
    return content


def _keys(name: str, path: str) -> _Keys:
    """The steps of a path: (key, index or None)."""
    keys = path.split('.')
    if not all(keys):
        raise SettingsError(f'{name}: {path!r} has an empty key')
    return tuple((key, int(key) if key.isascii() and key.isdecimal() else None) for key in keys)


def _at(value: Any, path: str, keys: _Keys) -> Any:
    """What stands at a path, or Rejected."""
    for key, index in keys:
        if isinstance(value, dict) and key in value:
            value = value[key]
        elif isinstance(value, list) and index is not None and index < len(value):
            value = value[index]
        else:
            raise Rejected(f'without {path}')
    return value


def _number(value: object, path: str) -> int | float:
    """A number, which a bool is not in JSON."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Rejected(f'whose {path} is no number')
    return value


def _axis(value: object, path: str) -> float:
    """An axis, NaN where it is null."""
    return float('nan') if value is None else axis_value(_number(value, path))


def _ticks(value: object, path: str) -> float:
    """The device's clock, which must be there."""
    return ticks_value(_number(value, path))


def _sequence(value: object, path: str) -> int:
    """The device's count; JSON does not tell 12 from 12.0."""
    value = _number(value, path)
    if isinstance(value, float):
        if not value.is_integer():
            raise Rejected(f'whose {path} is no integer')
        value = int(value)
    return sequence_value(value)


def _sensor(value: object, path: str) -> str:
    """The name of the sensor, which may be a number."""
    if isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    if not isinstance(value, str):
        raise Rejected(f'whose {path} is no name')
    return sensor_name(value)


_CONVERTERS: dict[str, _Converter] = {'sensor': _sensor, 'ticks': _ticks, 'sequence': _sequence}
