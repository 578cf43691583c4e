"""Fields of a frame as named in the settings, and conversion of their values to readings.

A field is one of `sensor`, `ticks`, `sequence`, the axes `x y z` of the magnetic field, the axes
`ax ay az` of the acceleration, or `-` for a value to be skipped. If a frame contains several
sensors, an axis has the sensor's name after the first dot (`x.A`).
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, TypeAlias, TypeVar

from mag_tracking.drivers.reading import DeviceDate, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.units import FORMS, parse_time

FIELD, ACCELERATION = ('x', 'y', 'z'), ('ax', 'ay', 'az')
AXES = FIELD + ACCELERATION
FRAME_QUANTITIES = ('sensor', 'ticks', 'sequence')
"""Fields that belong to the frame, not to one sensor."""
SKIP = '-'
Values: TypeAlias = Sequence[Any]
"""Values of one frame; the type of each follows from its field."""
MAX_NAME = 64
_ESCAPE_PATTERN = re.compile(r'\\(x[0-9A-Fa-f]{2}|.?)', re.DOTALL)
_ESCAPED_CHARACTERS = {'n': '\n', 'r': '\r', 't': '\t', '0': '\0', '\\': '\\'}
_Choice = TypeVar('_Choice', bound=str)


class Rejected(ValueError):
    """Rejection of a line or frame, with a remedy, and a cause such as 'with a wrong checksum',
    which has no values of the line, because causes are counted."""

    def __init__(self, cause: str, remedy: str = '') -> None:
        super().__init__(cause)
        self.remedy = remedy


class FieldLayout:
    """Converts the values of one frame to one reading per sensor.

    `fields` are in the order in which they are sent. For identical sensors '0', '1', ..., `each`
    (axes and skipped values of one sensor, without its name) follows `count` times. `quantities`
    are the fields of all values without the names of sensors.
    """

    def __init__(self, fields: Sequence[str], each: Sequence[str] = (), count: int = 0) -> None:
        names = _expand(tuple(fields), tuple(each), count)
        index: dict[str, int] = {}
        sensors: dict[str, dict[str, int]] = {}
        for i, name in enumerate(names):
            if name == SKIP:
                continue
            if name in index:
                raise SettingsError(f'fields: {name} appears twice')
            index[name] = i
            quantity, sensor = _split(name)
            if quantity in AXES:
                sensors.setdefault(sensor, {})[quantity] = i
        if not sensors:
            raise SettingsError(f'fields: expected at least one of {" ".join(AXES)}, got '
                                f'{list(names)}')
        if '' in sensors and len(sensors) > 1:
            raise SettingsError('fields: either all axes or none must name a sensor (x.A), got '
                                f'{list(names)}')
        self.quantities = tuple(_split(name)[0] for name in names)
        # `readings` appends a NaN and a None to the values, for fields that the frame lacks.
        self._device = index.get('sensor')
        self._ticks, self._sequence = index.get('ticks', -1), index.get('sequence', -1)
        self._sensors = [(sensor, _axes_getter(axes, FIELD), _axes_getter(axes, ACCELERATION))
                         for sensor, axes in sensors.items()]

    def readings(self, values: Values) -> list[Reading]:
        """Readings of one frame, in the order in which the sensors first appear.

        `values` has for each of `quantities` a float for an axis (NaN if missing) or `ticks`, a str
        for `sensor`, an int for `sequence`. If both the field `sensor` and axes name sensors, a dot
        joins the names ('board.A').
        """
        v = [*values, math.nan, None]
        ticks, sequence = v[self._ticks], v[self._sequence]
        device = '' if self._device is None else v[self._device]
        return [Reading(f'{device}.{name}' if device and name else device or name, field(v),
                        acceleration(v), ticks, sequence)
                for name, field, acceleration in self._sensors]


def _split(name: str) -> tuple[str, str]:
    """Split a field such as `x.A` into (quantity, sensor); the sensor may be empty."""
    quantity, _, sensor = name.partition('.')
    return quantity, sensor


def _axes_getter(axes: Mapping[str, int], names: Sequence[str]) -> Callable[[Values], Any]:
    """Function that selects three axes from the values of a frame, followed by NaN and None."""
    if not any(name in axes for name in names):
        return itemgetter(-1)
    return itemgetter(*(axes.get(name, -2) for name in names))


def _expand(fields: tuple[str, ...], each: tuple[str, ...], count: int) -> tuple[str, ...]:
    for name in fields:
        quantity, sensor = _split(name)
        if quantity not in (AXES if '.' in name else (*FRAME_QUANTITIES, *AXES, SKIP)):
            raise SettingsError(f'fields: {name!r}: expected one of '
                                f'{" ".join((*FRAME_QUANTITIES, *AXES))} or - (only an axis may '
                                'name a sensor, such as x.A)')
        if '.' in name and not _is_valid_name(sensor):
            raise SettingsError(f'fields: {name!r}: expected a sensor name of 1 to {MAX_NAME} '
                                'printable characters')
    for name in each:
        if name not in (*AXES, SKIP):
            raise SettingsError(f'each: expected {" ".join(AXES)} or -, got {name!r}')
    if bool(each) != (count > 0):
        raise SettingsError(f'each and count must be set together, got {list(each)} and {count}')
    return fields + tuple(name if name == SKIP else f'{name}.{i}'
                          for i in range(count) for name in each)


def _is_valid_name(name: str) -> bool:
    return 0 < len(name) <= MAX_NAME and name.isprintable()


def axis_value(value: float | bytes) -> float:
    """Convert a number or its text to float; raises Rejected if it is infinite."""
    try:
        value = float(value)
    except OverflowError:
        raise Rejected('with an infinite number') from None
    if math.isinf(value):
        raise Rejected('with an infinite number')
    return value


def ticks_value(value: float) -> float:
    """Convert a device time to float; raises Rejected if it is not finite."""
    value = axis_value(value)
    if math.isnan(value):
        raise Rejected('without ticks')
    return value


def text_number(text: str, decimal: str) -> float:
    """Convert a text to float; raises ValueError unless it is decimal, nan or inf."""
    text = text.strip()
    if decimal == ',':
        text = text.replace(',', '.')
    if '_' in text or not text.isascii():
        raise ValueError(text)
    return float(text)


def text_ticks(text: str, decimal: str) -> float:
    """Convert the text of a device time: a finite number, a date and time, or a time of day."""
    try:
        value = text_number(text, decimal)
    except ValueError:
        try:
            return DeviceDate(parse_time(text)[0] // 1000)
        except ValueError:
            raise Rejected('with a time that is neither a number nor a date',
                           f'accepted are numbers and {FORMS}') from None
    return ticks_value(value)


def decimal_remedy(text: str) -> str:
    """Remedy for a text that is not a number."""
    if ',' in text and re.fullmatch(r'[+-]?[0-9]*,[0-9]+', text.strip()):
        return "the decimal mark is a comma: set decimal: ','"
    return f'{text[:30]!r} is not a number; fields: - skips a value'


def sequence_value(value: int) -> int:
    """Check a sequence number; raises Rejected outside -2^63 .. 2^64 - 1."""
    if not -2**63 <= value < 2**64:
        raise Rejected('with a sequence number of more than 64 bits')
    return value


def sensor_name(text: str) -> str:
    """Check the name of a sensor; raises Rejected if it is empty, too long or unprintable."""
    if not _is_valid_name(text):
        raise Rejected('with an invalid sensor name')
    return text


def ignore_value(value: object) -> None:
    """Discard a skipped value."""


def decode_escapes(setting: str, text: str) -> bytes:
    r"""Encode a string, with the escape sequences \n, \r, \t, \0, \\ and \xhh, as UTF-8, so that
    both kinds of YAML quotes have the same effect."""
    def character(match: re.Match[str]) -> str:
        code = match[1]
        if code in _ESCAPED_CHARACTERS:
            return _ESCAPED_CHARACTERS[code]
        if len(code) == 3 and int(code[1:], 16) < 0x80:
            return chr(int(code[1:], 16))
        raise SettingsError(f'{setting}: unknown escape sequence {match[0]!r}; expected \\n \\r '
                            '\\t \\0 \\\\ or \\x00 .. \\x7f')

    try:
        return _ESCAPE_PATTERN.sub(character, text).encode()
    except UnicodeEncodeError:
        raise SettingsError(f'{setting}: {text!r} cannot be encoded as UTF-8') from None


def check_choice(setting: str, value: str, choices: Sequence[_Choice]) -> _Choice:
    """Return a setting if it is one of the permitted values."""
    if value not in choices:
        raise SettingsError(f'{setting}: expected one of {", ".join(choices)}, got {value!r}')
    return choices[choices.index(value)]
