"""What the values of one frame mean: names in the settings to readings.

A field is one of `sensor`, `ticks`, `sequence`, the axes `x y z` of the magnetic
field, the axes `ax ay az` of the acceleration, or `-` for a value to be skipped.
Where a frame holds several sensors, an axis carries the sensor's name behind the
first dot (`x.A`).
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, TypeAlias, TypeVar

from mag_tracking.drivers.reading import Reading
from mag_tracking.errors import SettingsError

FIELD, ACCELERATION = ('x', 'y', 'z'), ('ax', 'ay', 'az')
AXES = FIELD + ACCELERATION
OF_THE_FRAME = ('sensor', 'ticks', 'sequence')
SKIP = '-'
Values: TypeAlias = Sequence[Any]
"""Of one frame; the type of each follows from its field."""
MAX_NAME = 64
"""Characters of a sensor's name at most."""
_ESCAPE = re.compile(r'\\(x[0-9A-Fa-f]{2}|.?)', re.DOTALL)
_ESCAPED = {'n': '\n', 'r': '\r', 't': '\t', '0': '\0', '\\': '\\'}
_Choice = TypeVar('_Choice', bound=str)


class Rejected(ValueError):
    """A line or frame gives no reading; the text is the cause, behind 'lines' or 'frames'."""


class FieldLayout:
    """Turns the values of one frame into one reading per sensor.

    Attributes
    ----------
    quantities : tuple of str
        What each value of a frame is, in the order sent: a field's name without the
        sensor. So many values has a frame.
    """

    def __init__(self, fields: Sequence[str], each: Sequence[str] = (), count: int = 0) -> None:
        """
        Parameters
        ----------
        fields : sequence of str
            In the order sent.
        each : sequence of str
            Axes and skips of one of many like sensors, without a sensor's name;
            repeated `count` times behind `fields`, the sensors being '0', '1', ...
        count : int

        Raises SettingsError for an unknown field, a field twice, or no axis at all.
        """
        names = _expanded(tuple(fields), tuple(each), count)
        index: dict[str, int] = {}
        sensors: dict[str, dict[str, int]] = {}
        for i, name in enumerate(names):
            if name == SKIP:
                continue
            if name in index:
                raise SettingsError(f'fields: {name} is there twice')
            index[name] = i
            quantity, sensor = _parts(name)
            if quantity in AXES:
                sensors.setdefault(sensor, {})[quantity] = i
        if not sensors:
            raise SettingsError(f'fields: none of {" ".join(AXES)} is there, in {list(names)}')
        if '' in sensors and len(sensors) > 1:
            raise SettingsError('fields: either every axis belongs to a named sensor (x.A), or '
                                f'none; got {list(names)}')
        self.quantities = tuple(_parts(name)[0] for name in names)
        # Behind the values stand a NaN and a None for what the frame does not hold.
        self._device = index.get('sensor')
        self._ticks, self._sequence = index.get('ticks', -1), index.get('sequence', -1)
        self._sensors = [(sensor, _triple(axes, FIELD), _triple(axes, ACCELERATION))
                         for sensor, axes in sensors.items()]

    def readings(self, values: Values) -> list[Reading]:
        """The readings of one frame, in the order in which the sensors first appear.

        Parameters
        ----------
        values : sequence, as long as `quantities`
            float for an axis (NaN = missing), str for `sensor`, float for `ticks`, int
            for `sequence`, anything for a skip.

        Returns
        -------
        list of Reading
            The same ticks and sequence in all. A frame with `sensor` and named sensors
            gives the names joined by a dot ('board.A').
        """
        v = [*values, math.nan, None]
        ticks, sequence = v[self._ticks], v[self._sequence]
        if self._device is None:
            return [Reading(name, field(v), acceleration(v), ticks, sequence)
                    for name, field, acceleration in self._sensors]
        device = v[self._device]
        return [Reading(f'{device}.{name}' if name else device, field(v), acceleration(v),
                        ticks, sequence)
                for name, field, acceleration in self._sensors]


def _parts(name: str) -> tuple[str, str]:
    """(quantity, sensor) of a field's name."""
    quantity, _, sensor = name.partition('.')
    return quantity, sensor


def _triple(axes: Mapping[str, int], names: Sequence[str]) -> Callable[[Values], Any]:
    """From the values of a frame to three axes, or to None where it holds none of them."""
    if not any(name in axes for name in names):
        return itemgetter(-1)
    return itemgetter(*(axes.get(name, -2) for name in names))


def _expanded(fields: tuple[str, ...], each: tuple[str, ...], count: int) -> tuple[str, ...]:
    """All names of a frame, checked one by one."""
    for name in fields:
        quantity, sensor = _parts(name)
        if quantity not in (AXES if '.' in name else (*OF_THE_FRAME, *AXES, SKIP)):
            raise SettingsError(f'fields: {name!r} is none of {" ".join((*OF_THE_FRAME, *AXES))} '
                                'or - (and only an axis may have a sensor, as in x.A)')
        if '.' in name and not _usable(sensor):
            raise SettingsError(f'fields: {name!r}: the name of a sensor has 1 to {MAX_NAME} '
                                'printable characters')
    for name in each:
        if name not in (*AXES, SKIP):
            raise SettingsError(f'each: {name!r} is none of {" ".join(AXES)} or -')
    if bool(each) != (count > 0):
        raise SettingsError(f'each and count go together, got {list(each)} and {count}')
    return fields + tuple(name if name == SKIP else f'{name}.{i}'
                          for i in range(count) for name in each)


def _usable(name: str) -> bool:
    """Whether a sensor may have this name."""
    return 0 < len(name) <= MAX_NAME and name.isprintable()


def axis_value(value: float | bytes) -> float:
    """`value` as a float; NaN = missing. Raises Rejected where it is infinite."""
    try:
        value = float(value)
    except OverflowError:
        raise Rejected('with an infinite number') from None
    if math.isinf(value):
        raise Rejected('with an infinite number')
    return value


def ticks_value(value: float) -> float:
    """`value` as a float [ticks]. Raises Rejected where it is not finite."""
    value = axis_value(value)
    if math.isnan(value):
        raise Rejected('without ticks')
    return value


def sequence_value(value: int) -> int:
    """`value`, an int. Raises Rejected where no counter of 64 bits holds it."""
    if not -2**63 <= value < 2**64:
        raise Rejected('with a sequence of more than 64 bits')
    return value


def sensor_name(text: str) -> str:
    """`text` if a sensor may have this name. Raises Rejected."""
    if not _usable(text):
        raise Rejected('with an unusable sensor name')
    return text


def skipped(value: object) -> None:
    """Nothing, in the place of a value that is not asked for."""
    return None


def unescaped(setting: str, text: str) -> bytes:
    r"""The bytes (UTF-8) of a text in which \n \r \t \0 \\ and \xhh may stand for characters.

    So both quotes of YAML mean the same. Raises SettingsError that names `setting`.
    """
    def character(match: re.Match[str]) -> str:
        code = match[1]
        if code in _ESCAPED:
            return _ESCAPED[code]
        if len(code) == 3 and int(code[1:], 16) < 0x80:
            return chr(int(code[1:], 16))
        raise SettingsError(f'{setting}: {match[0]!r} is none of \\n \\r \\t \\0 \\\\ '
                            '\\x00 .. \\x7f')

    try:
        return _ESCAPE.sub(character, text).encode()
    except UnicodeEncodeError:
        raise SettingsError(f'{setting}: {text!r} has no UTF-8') from None


def chosen(setting: str, value: str, choices: Sequence[_Choice]) -> _Choice:
    """`value`, if it is one of `choices`. Raises SettingsError that names `setting`."""
    if value not in choices:
        raise SettingsError(f'{setting}: {value!r} is none of {", ".join(choices)}')
    return choices[choices.index(value)]
