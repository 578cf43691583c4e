"""Framing of the binary protocol of the Xsens MTi and MTx.

A message consists of the preamble 0xFA, the address 0xFF, its type (MID), the length of DATA (one
byte, or 0xFF and two bytes), DATA, and a checksum byte, which makes the sum of all bytes but the
preamble a multiple of 256. A false message, bytes that only look like one, has a valid checksum
with probability 1/256. Further checks are therefore applied:

- The type must be one that devices send: MTData2, MTData, WakeUp, Error, or a reply, whose MID is
  that of the request plus one, and therefore odd.
- The message must not be longer than the settings permit.
- The packets of MTData2 must fill the message, and MTData must have the configured length.
- A message that contains the start of a valid data message is rejected: it is garbage, or it has
  lost bytes and includes bytes of the next message.

A false message that begins before a true data message hides it only if it is a data message, and
both together are longer than the longest frame, or it has lost one byte for which the preamble of
the next message takes its place. One that overlaps no true message may be accepted. After a
rejected message, the search continues at the byte after its preamble.

Field and acceleration are in the sensor frame: the coordinate bits of a data identifier (0x4 NED,
0x8 NWU) apply to the orientation only (MT0101P, note to revision W) and are ignored.

Sources: Xsens, "MT Low Level Communication Protocol Documentation", MT0101P, revision 2019.A:
message structure, message listing, MTData2 with its data identifiers and fixed point formats;
Xsens, "MTi User Manual", MT0605P, section 5.3.2: acknowledgements; Xsens, "MTi and MTx User Manual
and Technical Documentation", MT0100P.N, section 5.3: SetOutputSettings and MTData.
"""

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from mag_tracking.drivers.reading import Axes, Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

TICK_S = 1e-4
"""[s] Tick of SampleTimeFine. The counter wraps at 2^32 (MTi 1 and 600 series), or at 864 000 000
ticks, which is one day (MTi 10 and 100 series)."""

_PACKET_COUNTER = 0x1020
_SAMPLE_TIME_FINE = 0x1060
_ACCELERATION = 0x4020
_MAGNETIC_FIELD = 0xC020
_RAW_VALUE_GROUP = 0xA000
"""Identifier group of the raw sensor values."""
_MAGNETIC_GROUP = 0xC000
_TYPE_MASK = 0xFFF0
_GROUP_MASK = 0xFE00

_FLOAT, _FIXED_12_20, _FIXED_16_32 = 0, 1, 2
_TRIPLE_FORMATS = (struct.Struct('>3f'), struct.Struct('>3i'), struct.Struct('>IhIhIh'),
                   struct.Struct('>3d'))
"""Formats of three real numbers, indexed by the two precision bits of the identifier."""

_BLOCK_LENGTHS = {
    'temp': 4, 'acc': 12, 'gyr': 12, 'mag': 12, 'quaternion': 16, 'euler': 12, 'matrix': 36,
    'analog_1': 2, 'analog_2': 2, 'status': 1, 'counter': 2}
"""Length in bytes of the blocks of MTData, in the order of the protocol."""
_ORIENTATIONS = {'quaternion', 'euler', 'matrix'}
_FORMATS = {'float': _FLOAT, 'fp12.20': _FIXED_12_20}


class DecodedMessage(NamedTuple):
    """Reading of a data message, and the causes for which data were ignored."""

    reading: Reading | None
    """None if the message has neither field nor acceleration."""
    causes: tuple[str, ...]
    """One cause for each occurrence of ignored data."""


def _three_reals(data: bytes, precision: int) -> Axes | None:
    """Decode three real numbers; None if the length of `data` does not match `precision`."""
    layout = _TRIPLE_FORMATS[precision]
    if len(data) != layout.size:
        return None
    values = layout.unpack(data)
    if precision == _FIXED_12_20:
        return tuple(v / 2**20 for v in values)
    if precision == _FIXED_16_32:
        # The fraction is sent first, then the signed integer part.
        return tuple(whole + fraction / 2**32
                     for fraction, whole in zip(values[::2], values[1::2], strict=True))
    return values


def _decode_packet(identifier: int, data: bytes) -> tuple[str, float | Axes | None] | None:
    """Decode a packet into (attribute of `Reading`, value), None if it is not used; the value is
    None if the length of the packet is wrong."""
    if identifier == _PACKET_COUNTER:
        return 'sequence', int.from_bytes(data, 'big') if len(data) == 2 else None
    if identifier == _SAMPLE_TIME_FINE:
        return 'ticks', float(int.from_bytes(data, 'big')) if len(data) == 4 else None
    kind = identifier & _TYPE_MASK
    if kind == _MAGNETIC_FIELD:
        return 'field', _three_reals(data, identifier & 3)
    if kind == _ACCELERATION:
        return 'acceleration', _three_reals(data, identifier & 3)
    return None


def read_mtdata2(data: bytes) -> DecodedMessage | None:
    """Decode DATA of an MTData2 message; None if a packet has a wrong length.

    A packet is an identifier (u16), the length of its data (u8), and the data. SampleTimeCoarse
    (0x1070) is too coarse for a clock.
    """
    values: dict[str, Any] = {}
    causes: list[str] = []
    position, end = 0, len(data)
    while position < end:
        begin = position + 3
        if begin > end:
            return None
        identifier = data[position] << 8 | data[position + 1]
        position = begin + data[begin - 1]
        if position > end:
            return None
        decoded = _decode_packet(identifier, data[begin:position])
        if decoded is None:
            if identifier & _GROUP_MASK in (_RAW_VALUE_GROUP, _MAGNETIC_GROUP):
                causes.append(f'packets not used: 0x{identifier:04X}')
            continue
        name, value = decoded
        if value is None:
            return None
        if name in values:
            causes.append(f'duplicate packets in a message: 0x{identifier:04X}')
            continue
        values[name] = value
    return _decoded_message(values, causes)


def _decoded_message(values: Mapping[str, Any], causes: Sequence[str]) -> DecodedMessage:
    if 'field' in values or 'acceleration' in values:
        return DecodedMessage(Reading(**values), tuple(causes))
    return DecodedMessage(None, (*causes, 'messages without field or acceleration'))


class MTDataLayout:
    """Layout of MTData messages, which do not describe it, so that it must be configured.

    `blocks` are keys of `_BLOCK_LENGTHS` in its order, at most one of them an orientation;
    `number_format` is a key of `_FORMATS`. `size` is the length of DATA in bytes.
    """

    def __init__(self, blocks: Sequence[str], number_format: str) -> None:
        for name in blocks:
            if name not in _BLOCK_LENGTHS:
                raise SettingsError(f'mtdata: unknown block {name!r}; known: '
                                    f'{", ".join(_BLOCK_LENGTHS)}')
        if list(blocks) != [name for name in _BLOCK_LENGTHS if name in blocks]:
            raise SettingsError(f'mtdata: expected blocks in protocol order, each at most once '
                                f'({", ".join(_BLOCK_LENGTHS)}), got {", ".join(blocks)}')
        if len(_ORIENTATIONS.intersection(blocks)) > 1:
            raise SettingsError(
                'mtdata: expected at most one of ' + ', '.join(sorted(_ORIENTATIONS)))
        if not {'acc', 'mag'}.intersection(blocks):
            raise SettingsError(f'mtdata: acc or mag is required, got {", ".join(blocks)}')
        if number_format not in _FORMATS:
            raise SettingsError(f'mtdata_format: expected one of {", ".join(_FORMATS)}, got '
                                f'{number_format!r}')
        self._precision = _FORMATS[number_format]
        self._begin: dict[str, int] = {}
        self.size = 0
        for name in blocks:
            self._begin[name] = self.size
            self.size += _BLOCK_LENGTHS[name]

    def read(self, data: bytes) -> DecodedMessage:
        """Decode DATA of `size` bytes of an MTData message."""
        values: dict[str, Any] = {}
        for block, name in (('mag', 'field'), ('acc', 'acceleration')):
            if block in self._begin:
                begin = self._begin[block]
                values[name] = _three_reals(data[begin:begin + 12], self._precision)
        if 'counter' in self._begin:
            values['sequence'] = int.from_bytes(data[self._begin['counter']:], 'big')
        return _decoded_message(values, ())


_PREAMBLE = b'\xfa'
_START = b'\xfa\xff'
_MTDATA, _MTDATA2, _WAKE_UP, _ERROR = 0x32, 0x36, 0x3E, 0x42
_DATA_MESSAGES = (_MTDATA, _MTDATA2)
_FROM_DEVICE = (*_DATA_MESSAGES, _WAKE_UP, _ERROR)
"""Even types of the messages that devices send."""
_EXTENDED_LENGTH = 0xFF
_MAX_OVERHEAD = 7
"""Number of bytes outside DATA in a message with extended length."""


@dataclass(frozen=True)
class XsensSettings:
    """Settings of the Xsens protocol."""

    max_message: int = param(
        512, 'Maximum length of the data of a message. A longer message is treated as garbage.',
        'bytes', (254, 4096))
    mtdata: tuple[str, ...] = param(
        ('none',), 'Blocks in the MTData messages of a first-generation MTi or MTx, according to '
        'its output mode and output settings, in this order: temp, acc, gyr, mag, quaternion or '
        'euler or matrix, analog_1, analog_2, status, counter. Set it to none if the device sends '
        'no MTData.')
    mtdata_format: str = param('float', 'Format of the numbers in MTData: float or fp12.20.')


class _Message(NamedTuple):
    """Type and position of a message in a window of bytes; it may end after the window."""

    mid: int
    begin: int
    """Index of the first byte of DATA."""
    end: int
    """Index of the byte after the checksum."""


class _ParseStep(NamedTuple):
    """Result of parsing a possible message at the beginning of a window."""

    length: int
    """Number of bytes consumed: 0 if more bytes are needed, 1 if the message is rejected."""
    causes: tuple[str, ...] = ()
    reading: Reading | None = None


_WAIT_STEP = _ParseStep(0)
_REJECT_STEP = _ParseStep(1)


def _message_at(window: bytes, index: int, longest: int) -> _Message | None:
    """Message with DATA of at most `longest` bytes that may begin at `index`, or None."""
    # While the header is incomplete, MID is -1 and the end is one byte after the window.
    header = window[index:index + 6]
    if not header.startswith(_START[:len(header)]):
        return None
    if len(header) > 2 and header[2] % 2 == 0 and header[2] not in _FROM_DEVICE:
        return None
    if len(header) < 4 or header[3] == _EXTENDED_LENGTH and len(header) < 6:
        return _Message(-1, len(window), len(window) + 1)
    length, begin = header[3], index + 4
    if length == _EXTENDED_LENGTH:
        length, begin = header[4] << 8 | header[5], index + 6
    if length > longest:
        return None
    return _Message(header[2], begin, begin + length + 1)


def _is_checksum_valid(window: bytes, index: int, message: _Message) -> bool:
    return sum(window[index + 1:message.end]) % 256 == 0


class XsensFraming:
    """Extracts readings from the messages of an MTi or MTx, a `Framing`.

    A reading has the field in arbitrary units (1 is the magnitude of the field where Xsens
    calibrated the sensor), the acceleration in m/s², the packet counter as sequence (modulo 2^16),
    and SampleTimeFine as ticks (10 kHz). Quantities that are not sent are None. A message with
    neither field nor acceleration is counted, and its sequence number is counted as lost.
    """

    SETTINGS = XsensSettings
    CLOCK = {'tick_s': TICK_S, 'wrap': 2**32}
    DRIVER = {'sequence_wrap': 2**16}

    def __init__(self, settings: XsensSettings) -> None:
        self._longest = settings.max_message
        self._layout: MTDataLayout | None = None
        if tuple(settings.mtdata) != ('none',):
            self._layout = MTDataLayout(settings.mtdata, settings.mtdata_format)
        elif settings.mtdata_format != 'float':
            raise SettingsError(f'mtdata_format is {settings.mtdata_format!r}, but mtdata is none; '
                                'set mtdata to the blocks of the messages')

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """Find all readings; see `Framing.parse`."""
        readings: list[Reading] = []
        rejected: Counter[str] = Counter()
        position = 0
        longest = self._longest + _MAX_OVERHEAD
        while True:
            start = data.find(_START, position)
            if start < 0:
                start = len(data) - data.endswith(_PREAMBLE, position)
            rejected['bytes between frames'] += start - position
            position = start
            if start == len(data):
                break
            window = data[start:start + longest]
            step = self._parse_step(window, not final and len(window) < longest)
            if step.length == 0:
                break
            position += step.length
            if step.length == 1:
                rejected['bytes between frames'] += 1
            rejected.update(step.causes)
            if step.reading is not None:
                readings.append(step.reading)
        return Parsed(tuple(readings), position, {c: n for c, n in rejected.items() if n})

    def _parse_step(self, window: bytes, more: bool) -> _ParseStep:
        """Parse the message at the beginning of `window`; `more` bytes may follow."""
        message = _message_at(window, 0, self._longest)
        if message is None:
            return _REJECT_STEP
        if message.end > len(window):
            return _WAIT_STEP if more else _REJECT_STEP
        if not _is_checksum_valid(window, 0, message):
            return _REJECT_STEP._replace(causes=('frames with a wrong checksum',))
        decoded = self._decode(window, message)
        if decoded is None and message.mid == _MTDATA2:
            return _REJECT_STEP._replace(causes=('MTData2 messages with invalid packet lengths',))
        step = self._search_inside(window, message, decoded is not None, more)
        if step is not None:
            return step
        if decoded is None:
            return _ParseStep(message.end, (self._cause(window, message),))
        return _ParseStep(message.end, decoded.causes, decoded.reading)

    def _search_inside(self, window: bytes, outer: _Message, outer_is_data: bool,
                       more: bool) -> _ParseStep | None:
        """Step that rejects `outer` for a data message in it, or waits for bytes; None without."""
        rejection = _REJECT_STEP._replace(causes=('messages that contain the start of another',))
        index = 0
        while True:
            # The checksum of a message may also be the preamble of the next. A data message does
            # not wait for the byte after it; otherwise one in 256 data messages would be delayed.
            index = self._next_start(window, index + 1, outer.end, outer_is_data)
            if index < 0:
                return None
            inner = _message_at(window, index, self._longest)
            if inner is None or inner.mid not in (-1, *_DATA_MESSAGES):
                continue
            if inner.end > len(window):
                if more:
                    return _WAIT_STEP
                if len(window) == self._longest + _MAX_OVERHEAD and not outer_is_data:
                    return rejection
            elif (_is_checksum_valid(window, index, inner)
                  and self._decode(window, inner) is not None):
                return rejection

    @staticmethod
    def _next_start(window: bytes, index: int, end: int, complete: bool) -> int:
        """Index of the next message start from `index` on, of which both bytes (if `complete`) or
        the first are before `end`; -1 without such a start."""
        found = window.find(_START, index, end if complete else end + 1)
        if found < 0 and not complete and end == len(window) and window.endswith(_PREAMBLE, index):
            return end - 1
        return found

    def _decode(self, window: bytes, message: _Message) -> DecodedMessage | None:
        data = window[message.begin:message.end - 1]
        if message.mid == _MTDATA2:
            return read_mtdata2(data)
        if message.mid == _MTDATA and self._layout is not None and len(data) == self._layout.size:
            return self._layout.read(data)
        return None

    def _cause(self, window: bytes, message: _Message) -> str:
        if message.mid == _MTDATA:
            if self._layout is None:
                return 'MTData messages, although mtdata is none'
            return 'MTData messages whose length does not match mtdata'
        if message.mid == _ERROR:
            if message.end - message.begin < 2:
                return 'error messages without a code'
            return f'error messages with code 0x{window[message.begin]:02X}'
        return f'other messages: 0x{message.mid:02X}'
