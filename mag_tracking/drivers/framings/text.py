"""Framing of text lines that contain separated values, with or without a checksum."""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from mag_tracking.drivers.framings import fields
from mag_tracking.drivers.framings.binary import xor8
from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

# Each character matches in only one way; otherwise a long line would take quadratic time.
_NUMBER = re.compile(rb'[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?').fullmatch
_MISSING = re.compile(rb'(?:[+-]?nan)?', re.IGNORECASE).fullmatch
_INFINITE = re.compile(rb'[+-]?inf(?:inity)?', re.IGNORECASE).fullmatch
DATE = 'date'
"""Field that is joined with the ticks."""
MAX_SHOWN = 100
"""Maximum length of a rejected line in a message [bytes]."""
_INTEGER = re.compile(rb'[+-]?[0-9]{1,20}').fullmatch


@dataclass(frozen=True)
class TextSettings:
    """Settings of the framing of text lines."""

    fields: tuple[str, ...] = param(
        (), 'Values of a line, in the order sent. Each is sensor, ticks, sequence, x, y, z, ax, '
        'ay, az, or - to skip a value. x.A is an axis of sensor A, for lines with several sensors. '
        'If date and time of day are two values, they are date and ticks.')
    each: tuple[str, ...] = param(
        (), 'Axes of one sensor, for lines with several identical sensors. They are repeated '
        '`count` times after `fields`.')
    count: int = param(0, 'Number of identical sensors described by `each`.', '', (0, 4096))
    separator: str = param(',', 'Separator between values; a blank stands for any white space.')
    decimal: str = param('.', 'Decimal mark of the numbers: . or a comma.', choices=('.', ','))
    end: str = param('\\n', 'Line terminator. A carriage return before it is removed.')
    prefix: str = param('', 'Prefix of every line with readings; lines without it are rejected.')
    comment: str = param(
        '', 'Prefix of comment lines, which are skipped and counted; empty if there are none.')
    checksum: str = param(
        'none', 'Checksum: none, or nmea (a line ends in * and two hexadecimal digits, the '
        'exclusive or of the preceding characters without a leading $).')
    max_length: int = param(
        512, 'Maximum length of a line without its terminator.', 'bytes', (1, 65536))


class Lines:
    """Splits bytes into lines of at most `max_length` bytes and counts invalid lines."""

    def __init__(self, end: str, max_length: int) -> None:
        self.end = fields.decode_escapes('end', end)
        if not self.end:
            raise SettingsError('end: at least one character is required, such as \\n')
        self.max_length = max_length

    def parse(self, data: bytes, final: bool, read: Callable[[bytes], list[Reading]]) -> Parsed:
        """Parse all lines, as `Framing.parse`; `read` returns the readings of a line, valid UTF-8
        that is neither empty nor too long, or raises Rejected."""
        *lines, rest = data.split(self.end)
        if final:
            lines += [rest] if rest else []
            return self.read(lines, len(data), read)
        # The last bytes of an overlong line remain, enough for the next call to reject the line.
        n_unconsumed = min(len(rest), self.max_length + len(self.end))
        return self.read(lines, len(data) - n_unconsumed, read)

    def read(self, lines: Iterable[bytes], consumed: int,
             read: Callable[[bytes], list[Reading]]) -> Parsed:
        """Parse lines that are already separated; `consumed` is reported in the result."""
        readings: list[Reading] = []
        rejected: Counter[str] = Counter()
        examples: dict[str, str] = {}
        for line in lines:
            try:
                readings += read(self._clean(line))
            except fields.Rejected as cause:
                rejected[f'lines {cause}'] += 1
                if cause.remedy and f'lines {cause}' not in examples:
                    shown = line[:MAX_SHOWN].decode(errors='backslashreplace')
                    examples[f'lines {cause}'] = f'{shown!r}: {cause.remedy}'
        return Parsed(tuple(readings), consumed, rejected, examples)

    def _clean(self, line: bytes) -> bytes:
        """Remove the carriage return of a line that is neither too long, empty nor not UTF-8."""
        if len(line) > self.max_length:
            raise fields.Rejected('longer than max_length')
        if not line.isascii():
            try:
                line.decode()
            except UnicodeDecodeError:
                raise fields.Rejected('that are not UTF-8') from None
        line = line.removesuffix(b'\r')
        if not line or line.isspace():
            raise fields.Rejected('that are empty')
        return line


class TextFraming:
    """Extracts readings from lines of text, one frame per line, a `Framing`.

    An axis is missing if it is `nan` or empty; all other numbers are decimal, with or without
    quotation marks. A line that does not match the settings is rejected as a whole. Without a
    prefix or a checksum (NMEA 0183, section "Checksum field"), part of a line may be mistaken for a
    complete line: '12.5,3,4' is also the end of '-12.5,3,4'. If the data end within a line and
    `final` is set, '1,2,3' may be the beginning of '1,2,34'.
    """

    SETTINGS = TextSettings

    def __init__(self, settings: TextSettings) -> None:
        self._lines = Lines(settings.end, settings.max_length)
        names = settings.fields
        self._date: tuple[int, int] | None = None
        if DATE in names:
            if 'ticks' not in names:
                raise SettingsError('fields: date needs ticks, the time of day')
            self._date = names.index(DATE), names.index('ticks')
        self._layout = fields.FieldLayout([fields.SKIP if name == DATE else name for name in names],
                                          settings.each, settings.count)
        self._prefix = fields.decode_escapes('prefix', settings.prefix)
        self._comment = fields.decode_escapes('comment', settings.comment)
        self._has_checksum = fields.check_choice(
            'checksum', settings.checksum, ('none', 'nmea')) == 'nmea'
        separator = fields.decode_escapes('separator', settings.separator)
        self._separator = None if separator == b' ' else separator
        if settings.decimal == ',' and b',' in separator:
            raise SettingsError('decimal: a comma cannot be both separator and decimal mark; set '
                                'separator')
        self._converters = [_converter(q, settings.decimal) for q in self._layout.quantities]
        self._check_settings(separator)

    def _check_settings(self, separator: bytes) -> None:
        if not separator or re.search(rb'[0-9A-Za-z+.-]', separator):
            raise SettingsError(f'separator: {separator!r} is empty or can be part of a number')
        if self._lines.end in separator:
            raise SettingsError(f'separator: {separator!r} contains the end of the line')
        for name, text in (('prefix', self._prefix), ('comment', self._comment)):
            if self._lines.end in text:
                raise SettingsError(f'{name}: {text!r} contains the end of the line')
        if self._comment and self._prefix.startswith(self._comment):
            raise SettingsError(f'comment: every line with the prefix {self._prefix!r} begins '
                                f'with {self._comment!r} and would be ignored')

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """Find all readings; see `Framing.parse`."""
        return self._lines.parse(data, final, self._read)

    def _read(self, line: bytes) -> list[Reading]:
        if self._comment and line.startswith(self._comment):
            raise fields.Rejected('that are comments')
        if not line.startswith(self._prefix):
            raise fields.Rejected('without the prefix')
        if self._has_checksum:
            line = _strip_checksum(line)
        values = line[len(self._prefix):].split(self._separator)
        if len(values) != len(self._converters):
            raise fields.Rejected('with an unexpected number of fields',
                                  self._width_remedy(line, values))
        if self._date is not None:
            date, time = self._date
            values[time] = values[date] + b' ' + values[time]
        return self._layout.readings(
            [convert(text) for convert, text in zip(self._converters, values, strict=True)])

    def _width_remedy(self, line: bytes, values: list[bytes]) -> str:
        n = len(self._converters)
        for name, separator in (("';'", b';'), ("'\\t'", b'\t'), ("' '", None), ("','", b',')):
            if len(line[len(self._prefix):].split(separator)) == n:
                return f'set separator: {name}'
        return (f'it has {len(values)} values, and fields lists {n}; list every value (- skips '
                'one), or set the separator')


def _strip_checksum(line: bytes) -> bytes:
    if line[-3:-2] != b'*':
        raise fields.Rejected('without a checksum')
    line, digits = line[:-3], line[-2:]
    if digits.upper() != b'%02X' % xor8(line.removeprefix(b'$')):
        raise fields.Rejected('with a wrong checksum')
    return line


def _converter(quantity: str, decimal: str) -> Callable[[bytes], object]:
    """Function that converts the bytes of a quantity to a value for `FieldLayout.readings`."""
    if quantity in fields.AXES:
        return _axis if decimal == '.' else lambda text: _axis(text.replace(b',', b'.'))
    converters: dict[str, Callable[[bytes], object]] = {
        'ticks': lambda text: _ticks(text, decimal), 'sequence': _sequence, 'sensor': _sensor,
        fields.SKIP: fields.ignore_value}
    return converters[quantity]


def _axis(text: bytes) -> float:
    """Parse an axis, NaN if missing."""
    text = text.strip(b' \t"')
    if _NUMBER(text):
        return fields.axis_value(text)
    if _MISSING(text):
        return float('nan')
    if _INFINITE(text):
        raise fields.Rejected('with an infinite number')
    raise fields.Rejected('with a value that is not a number', fields.decimal_remedy(text.decode()))


def _ticks(text: bytes, decimal: str) -> float:
    text = text.strip(b' \t"')
    return fields.ticks_value(math.nan) if _MISSING(text) else \
        fields.text_ticks(text.decode(), decimal)


def _sequence(text: bytes) -> int:
    text = text.strip(b' \t"')
    if not _INTEGER(text):
        raise fields.Rejected('with a sequence number that is not an integer')
    return fields.sequence_value(int(text))


def _sensor(text: bytes) -> str:
    return fields.sensor_name(text.strip(b' \t"').decode())
