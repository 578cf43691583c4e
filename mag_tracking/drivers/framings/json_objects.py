"""Framing of JSON objects, one per line or one per message."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from mag_tracking.drivers.framings import fields
from mag_tracking.drivers.framings.text import Lines
from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

_Keys: TypeAlias = tuple[tuple[str, int | None], ...]
_Converter: TypeAlias = Callable[[object, str, str], object]
"""Function of a value, its path and the decimal mark."""
_LOOSE = re.compile(
    r"""("(?:[^"\\]|\\.)*")|'((?:[^'"\\]|\\.)*)'|(?<![\w$-])([A-Za-z_$][\w$-]*)(?=\s*:)"""
    r'|(?<![\w$-])(nan|None|True|False)(?![\w$-])')
"""Strings, and what JavaScript and Python write otherwise than JSON: strings in single quotes, keys
without quotes, other constants."""
MAX_LOOSE = 1024
"""Maximum length of an object that is not JSON."""
_CONSTANTS = {'nan': 'NaN', 'None': 'null', 'True': 'true', 'False': 'false'}


@dataclass(frozen=True)
class JsonSettings:
    """Settings of the framing of JSON objects.

    A path consists of keys and list indices joined by dots, such as `a.b.0`.
    """

    sensor: str = param(
        '', "Path of the sensor's name (a string or an integer); empty if it is not sent.")
    ticks: str = param('', 'Path of the device time; empty if it is not sent.')
    sequence: str = param('', 'Path of the sequence number; empty if it is not sent.')
    field: tuple[str, ...] = param(
        (), 'Paths of the three axes of the field (an empty path if an axis is not sent), or the '
        'path of a list of the three values.')
    acceleration: tuple[str, ...] = param(
        (), 'Paths of the acceleration, in the same form as `field`.')
    decimal: str = param(
        '.', 'Decimal mark of numbers in quotes: . or a comma.', choices=('.', ','))
    end: str = param('\\n', 'Line terminator. A carriage return before it is removed.')
    max_length: int = param(
        4096, 'Maximum length of a line or message without its terminator.', 'bytes', (2, 1 << 20))


class JsonFraming:
    """Extracts readings from JSON objects (RFC 8259), one reading per object, a `Framing`.

    An axis is missing if it is null or NaN; an object that lacks a configured path is rejected. An
    object that spans several lines is parsed only if the data are `final` and contain only this
    object. The parser also accepts what many libraries and devices write: NaN and Infinity, keys
    without quotes or in single quotes, and numbers in quotes.
    """

    SETTINGS = JsonSettings

    def __init__(self, settings: JsonSettings) -> None:
        self._lines = Lines(settings.end, settings.max_length)
        self._decimal = settings.decimal
        self._decode = json.JSONDecoder(object_pairs_hook=_object).decode
        self._lists: list[tuple[str, _Keys]] = []
        self._values: list[tuple[str, _Keys, _Converter]] = []
        names: list[str] = []
        for name in fields.FRAME_QUANTITIES:
            if path := getattr(settings, name):
                names.append(name)
                self._values.append((path, _split_path(name, path), _CONVERTERS[name]))
        for name, axes in (('field', fields.FIELD), ('acceleration', fields.ACCELERATION)):
            for axis, path in zip(axes, self._axis_paths(name, getattr(settings, name)),
                                  strict=True):
                if path:
                    names.append(axis)
                    self._values.append((path, _split_path(name, path), _axis))
        if not self._values or names[-1] in fields.FRAME_QUANTITIES:
            raise SettingsError('field: a path of the field or of the acceleration is required')
        self._layout = fields.FieldLayout(names)

    def _axis_paths(self, name: str, paths: tuple[str, ...]) -> tuple[str, ...]:
        """Paths of the three axes of setting `name`; the path of a list is added to `_lists`."""
        if len(paths) == 1 and paths[0]:
            self._lists.append((paths[0], _split_path(name, paths[0])))
            return tuple(f'{paths[0]}.{i}' for i in range(3))
        if any(paths) and len(paths) != 3:
            raise SettingsError(f'{name}: expected the paths of three axes, or the path of a list, '
                                f'got {list(paths)}')
        return paths if any(paths) else ('', '', '')

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """Find all readings; see `Framing.parse`."""
        if final and self._is_single_document(data):
            return self._lines.read([data], len(data), self._read)
        return self._lines.parse(data, final, self._read)

    def _is_single_document(self, data: bytes) -> bool:
        if self._lines.end not in data.strip() or len(data) > self._lines.max_length:
            return False
        try:
            self._decode_document(data)
        except fields.Rejected:
            return False
        return True

    def _decode_document(self, line: bytes) -> Any:
        try:
            text = line.decode()
            try:
                return self._decode(text)
            except json.JSONDecodeError:
                # The time for the substitution grows with the square of the length.
                if len(text) > MAX_LOOSE:
                    raise
                return self._decode(_LOOSE.sub(_strict, text))
        except RecursionError:
            raise fields.Rejected('that are nested too deeply') from None
        except fields.Rejected:
            raise
        except ValueError as error:
            # This includes integers with more digits than Python converts.
            remedy = f'{error}; lines of numbers have the framing text'[:200]
            raise fields.Rejected('that are not JSON', remedy) from None

    def _read(self, line: bytes) -> list[Reading]:
        content = self._decode_document(line)
        if not isinstance(content, dict):
            raise fields.Rejected('that are not a JSON object',
                                  'send objects such as {"x": 1.0, "y": 2.0, "z": 3.0}')
        for path, keys in self._lists:
            value = _lookup(content, path, keys)
            if not isinstance(value, list) or len(value) != 3:
                raise fields.Rejected(
                    f'whose {path} is not a list of three values',
                    'field needs the paths of x, y and z, or of a list of three values')
        return self._layout.readings([convert(_lookup(content, path, keys), path, self._decimal)
                                      for path, keys, convert in self._values])


def _strict(match: re.Match[str]) -> str:
    string, quoted, key, constant = match.groups()
    if string:
        return string
    if quoted is not None or key:
        return f'"{quoted if key is None else key}"'
    return _CONSTANTS[constant]


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise fields.Rejected('with a duplicate key')
    return content


def _split_path(name: str, path: str) -> _Keys:
    """Split a path into ((key, list index or None), ...)."""
    keys = path.split('.')
    if not all(keys):
        raise SettingsError(f'{name}: {path!r} has an empty key')
    return tuple((key, int(key) if key.isascii() and key.isdecimal() else None) for key in keys)


def _lookup(value: Any, path: str, keys: _Keys) -> Any:
    content = value
    for key, index in keys:
        if isinstance(value, dict) and key in value:
            value = value[key]
        elif isinstance(value, list) and index is not None and index < len(value):
            value = value[index]
        else:
            raise fields.Rejected(f'without {path}', f'the paths are {_paths(content)}'[:200])
    return value


def _paths(value: Any, prefix: str = '', depth: int = 3) -> list[str]:
    """Paths of the values that are not objects, and of those at the maximum depth."""
    if not isinstance(value, dict) or not value or not depth:
        return [prefix]
    return [path for key, inner in list(value.items())[:20]
            for path in _paths(inner, f'{prefix}.{key}' if prefix else key, depth - 1)]


def _number(value: object, path: str, decimal: str) -> int | float:
    """Return a number, or the number in its quotes."""
    if isinstance(value, str):
        try:
            return fields.text_number(value, decimal)
        except ValueError:
            raise fields.Rejected(f'whose {path} is not a number',
                                  fields.decimal_remedy(value)) from None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise fields.Rejected(f'whose {path} is not a number',
                              f'it is of the type {type(value).__name__}')
    return value


def _axis(value: object, path: str, decimal: str) -> float:
    return float('nan') if value in (None, '') else fields.axis_value(_number(value, path, decimal))


def _ticks(value: object, path: str, decimal: str) -> float:
    return fields.text_ticks(value, decimal) if isinstance(value, str) else fields.ticks_value(
        _number(value, path, decimal))


def _sequence(value: object, path: str, decimal: str) -> int:
    value = _number(value, path, decimal)
    if isinstance(value, float):
        if not value.is_integer():
            raise fields.Rejected(f'whose {path} is not an integer')
        value = int(value)
    return fields.sequence_value(value)


def _sensor(value: object, path: str, decimal: str) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    if not isinstance(value, str):
        raise fields.Rejected(f'whose {path} is not a name')
    return fields.sensor_name(value)


_CONVERTERS: dict[str, _Converter] = {'sensor': _sensor, 'ticks': _ticks, 'sequence': _sequence}
