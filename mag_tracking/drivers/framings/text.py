"""Framing of lines of text: numbers between separators, with or without a checksum."""

import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from mag_tracking.drivers.framings.checksums import xor8
from mag_tracking.drivers.framings.fields import (
    AXES,
    SKIP,
    FieldLayout,
    Rejected,
    axis_value,
    chosen,
    sensor_name,
    sequence_value,
    skipped,
    ticks_value,
    unescaped,
)
from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

# Each character has one place in these, or a long line would take quadratic time.
_NUMBER = re.compile(rb'[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?').fullmatch
_MISSING = re.compile(rb'(?:[+-]?nan)?', re.IGNORECASE).fullmatch
_INFINITE = re.compile(rb'[+-]?inf(?:inity)?', re.IGNORECASE).fullmatch
_INTEGER = re.compile(rb'[+-]?[0-9]{1,20}').fullmatch


@dataclass(frozen=True)
class TextSettings:
    """Settings of the framing of lines of text."""

    fields: tuple[str, ...] = param(
        (), 'What stands in a line, in order: sensor, ticks, sequence, x, y, z, ax, ay, az, or - '
        'for a value to be skipped; x.A is the axis of a sensor A, where there are several.')
    each: tuple[str, ...] = param(
        (), 'Axes of one sensor, which follow count times behind the fields.')
    count: int = param(0, 'How many sensors follow in the order of each.', '', (0, 4096))
    separator: str = param(',', 'Stands between two values; a blank is any white space.')
    end: str = param('\\n', 'Ends a line; a carriage return before it is dropped.')
    prefix: str = param('', 'How a line of readings begins; other lines are rejected.')
    comment: str = param('', 'How a line begins that is to be passed over; empty = none is.')
    checksum: str = param(
        'none', "none, or nmea: a line ends in * and two hexadecimal digits, the exclusive or of "
        'what stands before it, without a $ at the beginning.')
    max_length: int = param(512, 'Longest line, without its end.', 'bytes', (1, 65536))


class Lines:
    """Cuts bytes into lines and counts what cannot be read; as pure as a framing."""

    def __init__(self, end: str, max_length: int) -> None:
        """
        Parameters
        ----------
        end : str
            As in `TextSettings`; raises SettingsError where it is empty.
        max_length : int [bytes]
        """
        self.end = unescaped('end', end)
        if not self.end:
            raise SettingsError('end: the end of a line is empty')
        self.max_length = max_length

    def parse(self, data: bytes, final: bool, read: Callable[[bytes], list[Reading]]) -> Parsed:
        """All lines of `data`, as `Framing.parse`.

        Parameters
        ----------
        data : bytes
        final : bool
            What stands behind the last end is a line too.
        read : function
            From a line of valid UTF-8 (bytes, neither empty nor too long) to readings;
            raises Rejected.
        """
        *lines, rest = data.split(self.end)
        if final:
            lines += [rest] if rest else []
            return self.read(lines, len(data), read)
        # So much of a line that is too long stays that it is still too long in the next call.
        kept = min(len(rest), self.max_length + len(self.end))
        return self.read(lines, len(data) - kept, read)

    def read(self, lines: Iterable[bytes], consumed: int,
             read: Callable[[bytes], list[Reading]]) -> Parsed:
        """The `Parsed` of these lines; the other parameters as in `parse`."""
        readings: list[Reading] = []
        rejected: Counter[str] = Counter()
        for line in lines:
            try:
                readings += read(self._checked(line))
            except Rejected as cause:
                rejected[f'lines {cause}'] += 1
        return Parsed(tuple(readings), consumed, rejected)

    def _checked(self, line: bytes) -> bytes:
        """The line without its carriage return, or Rejected."""
        if len(line) > self.max_length:
            raise Rejected('that are too long')
        if not line.isascii():
            try:
                line.decode()
            except UnicodeDecodeError:
                raise Rejected('that are no UTF-8') from None
        line = line.removesuffix(b'\r')
        if not line or line.isspace():
            raise Rejected('that are empty')
        return line


class TextFraming:
    """Readings from lines of text, one frame a line.

    An axis is `nan` or nothing where it is missing; other numbers are decimal. A
    line that is not as the settings say is rejected as a whole. Without a prefix or a
    checksum, the second half of a line may look like a line: nothing tells '12.5,3,4'
    from the end of '-12.5,3,4', nor, where `final` is given for a line that is cut off,
    '1,2,3' from the beginning of '1,2,34'.

    Source: the checksum is that of NMEA 0183, section "Checksum field".
    """

    SETTINGS = TextSettings

    def __init__(self, settings: TextSettings) -> None:
        """Raises SettingsError."""
        self._lines = Lines(settings.end, settings.max_length)
        self._layout = FieldLayout(settings.fields, settings.each, settings.count)
        self._prefix = unescaped('prefix', settings.prefix)
        self._comment = unescaped('comment', settings.comment)
        self._nmea = chosen('checksum', settings.checksum, ('none', 'nmea')) == 'nmea'
        separator = unescaped('separator', settings.separator)
        self._separator = None if separator == b' ' else separator
        self._converters = [_converter(q) for q in self._layout.quantities]
        self._check(separator)

    def _check(self, separator: bytes) -> None:
        """Raises SettingsError where no line could be read."""
        if not separator or re.search(rb'[0-9A-Za-z+.-]', separator):
            raise SettingsError(f'separator: {separator!r} is empty or may be part of a number')
        if self._lines.end in separator:
            raise SettingsError(f'separator: {separator!r} holds the end of the line')
        for name, text in (('prefix', self._prefix), ('comment', self._comment)):
            if self._lines.end in text:
                raise SettingsError(f'{name}: {text!r} holds the end of the line')
        if self._comment and self._prefix.startswith(self._comment):
            raise SettingsError(f'comment: every line with the prefix {self._prefix!r} begins '
                                f'with {self._comment!r} and would be passed over')

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """All readings in `data`; see `Framing.parse`."""
        return self._lines.parse(data, final, self._read)

    def _read(self, line: bytes) -> list[Reading]:
        """The readings of one line, or Rejected."""
        if self._comment and line.startswith(self._comment):
            raise Rejected('that are comments')
        if not line.startswith(self._prefix):
            raise Rejected('without the prefix')
        if self._nmea:
            line = _without_checksum(line)
        values = line[len(self._prefix):].split(self._separator)
        if len(values) != len(self._converters):
            raise Rejected('with another number of fields')
        return self._layout.readings(
            [convert(text) for convert, text in zip(self._converters, values, strict=True)])


def _without_checksum(line: bytes) -> bytes:
    """What stands before `*hh`, or Rejected."""
    if line[-3:-2] != b'*':
        raise Rejected('without a checksum')
    line, digits = line[:-3], line[-2:]
    if digits.upper() != b'%02X' % xor8(line.removeprefix(b'$')):
        raise Rejected('with a wrong checksum')
    return line


def _converter(quantity: str) -> Callable[[bytes], object]:
    """From the bytes between two separators to the value that `FieldLayout` takes."""
    if quantity in AXES:
        return _axis
    others: dict[str, Callable[[bytes], object]] = {
        'ticks': _ticks, 'sequence': _sequence, 'sensor': _sensor, SKIP: skipped}
    return others[quantity]


def _axis(text: bytes) -> float:
    """An axis, NaN where there is nothing."""
    text = text.strip(b' \t')
    if _NUMBER(text):
        return axis_value(text)
    if _MISSING(text):
        return float('nan')
    raise Rejected('with an infinite number' if _INFINITE(text)
                   else 'with something that is no number')


def _ticks(text: bytes) -> float:
    """The device's clock, which must be there."""
    return ticks_value(_axis(text))


def _sequence(text: bytes) -> int:
    """The device's count, which must be there."""
    text = text.strip(b' \t')
    if not _INTEGER(text):
        raise Rejected('with a sequence that is no integer')
    return sequence_value(int(text))


def _sensor(text: bytes) -> str:
    """The name of the sensor."""
    return sensor_name(text.strip(b' \t').decode())
