"""Framing of fixed-length binary frames, which consist of sync, payload, checksum and tail."""

import binascii
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Any, Literal, TypeAlias

from mag_tracking.drivers.framings import fields
from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param


def xor8(data: bytes) -> int:
    """Exclusive or of the bytes, as in NMEA 0183."""
    return reduce(xor, data, 0)


def _table(step: Callable[[int], int]) -> list[int]:
    """CRC of each byte value; `step` processes one bit."""
    table = list(range(256))
    for _ in range(8):
        table = list(map(step, table))
    return table


_CRC8_TABLE = _table(lambda crc: crc << 1 ^ (0x107 if crc & 0x80 else 0))
_MODBUS_TABLE = _table(lambda crc: crc >> 1 ^ (0xA001 if crc & 1 else 0))


def crc8(data: bytes) -> int:
    """CRC-8/SMBUS: polynomial 0x07, initial value 0."""
    crc, table = 0, _CRC8_TABLE
    for byte in data:
        crc = table[crc ^ byte]
    return crc


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0x8005, reflected, initial value 0xFFFF."""
    crc, table = 0xFFFF, _MODBUS_TABLE
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc


CHECKSUMS: dict[str, tuple[int, Callable[[bytes], int]]] = {
    'sum8': (1, lambda data: sum(data) & 0xFF),
    'xor8': (1, xor8),
    'crc8': (1, crc8),
    # CRC-16/CCITT-FALSE (IBM-3740): polynomial 0x1021.
    'crc16_ccitt': (2, lambda data: binascii.crc_hqx(data, 0xFFFF)),
    'crc16_modbus': (2, crc16_modbus),
    # CRC-32 (ISO-HDLC), as in Ethernet and zip.
    'crc32': (4, zlib.crc32)}
"""Length in bytes and function, by the names in the settings, which are those of the "Catalogue of
parametrised CRC algorithms" (G. Cook), also the source of the polynomials."""
_STRUCT_CODES = {'u8': 'B', 'i8': 'b', 'u16': 'H', 'i16': 'h', 'u24': '3s', 'i24': '3s', 'u32': 'I',
                 'i32': 'i', 'u64': 'Q', 'i64': 'q', 'f32': 'f', 'f64': 'd'}
_ByteOrder: TypeAlias = Literal['little', 'big']
_Converter: TypeAlias = Callable[[Any], object]


@dataclass(frozen=True)
class BinarySettings:
    """Settings of the framing of binary frames."""

    sync: str = param('', 'Bytes at the beginning of a frame, hexadecimal, such as A5 5A.')
    fields: tuple[str, ...] = param(
        (), 'Values of the payload in order, each as name:type, such as x:i16. Names: sensor, '
        'ticks, sequence, x, y, z, ax, ay, az, or - to skip a value. x.A:i16 is an axis of sensor '
        'A, for frames with several sensors. Types: ' + ' '.join(_STRUCT_CODES) + '.')
    each: tuple[str, ...] = param(
        (), 'Axes and types of one sensor, for frames with several identical sensors. They are '
        'repeated `count` times after `fields`.')
    count: int = param(0, 'Number of identical sensors described by `each`.', '', (0, 4096))
    byte_order: str = param(
        'little', 'Byte order of all numbers and of the checksum: little or big.')
    checksum: str = param(
        'none', 'Checksum after the payload: none, ' + ', '.join(CHECKSUMS) + '.')
    checksum_from: str = param(
        'payload', 'Part of the frame at which the checksum begins: sync or payload.')
    tail: str = param('', 'Bytes at the end of a frame, hexadecimal; empty if there is no tail.')


class BinaryFraming:
    """Extracts readings from binary frames of `size` bytes, a `Framing`.

    If a frame is not valid, the search continues one byte after the beginning of its sync. If the
    frames have an n-bit checksum, every true frame is found, with one exception: a sync in garbage
    or in a payload begins a false frame, which is accepted with probability 2^-n and hides the true
    frames that begin within it. Without a checksum, every sync is accepted; a tail is a weak
    checksum. True frames are then found if they follow each other without a gap, or if the gap
    contains no sync. After any other gap, readings may be false or lost until it is aligned again.
    """

    SETTINGS = BinarySettings

    def __init__(self, settings: BinarySettings) -> None:
        self._sync = _parse_bytes('sync', settings.sync)
        if not self._sync:
            raise SettingsError('sync: at least one byte is required, such as A5')
        self._tail = _parse_bytes('tail', settings.tail)
        self._order: _ByteOrder = fields.check_choice(
            'byte_order', settings.byte_order, ('little', 'big'))
        name = fields.check_choice('checksum', settings.checksum, ('none', *CHECKSUMS))
        checksum_size, self._compute = CHECKSUMS.get(name, (0, lambda data: 0))
        first = fields.check_choice('checksum_from', settings.checksum_from, ('sync', 'payload'))
        frame, each = (_parse_fields('fields', settings.fields),
                       _parse_fields('each', settings.each))
        self._layout = fields.FieldLayout([name for name, _ in frame], [name for name, _ in each],
                                          settings.count)
        types = [kind for _, kind in frame + each * settings.count]
        self._struct = struct.Struct(
            '<>'[self._order == 'big'] + ''.join(_STRUCT_CODES[kind] for kind in types))
        self._converters = [_converter(quantity, kind, self._order) for quantity, kind
                            in zip(self._layout.quantities, types, strict=True)]
        self._payload_start = len(self._sync)
        self._coverage_start = 0 if first == 'sync' else self._payload_start
        self._payload_end = self._payload_start + self._struct.size
        self._checksum_end = self._payload_end + checksum_size
        self.size = self._checksum_end + len(self._tail)
        kinds = dict(frame)
        self.CLOCK: dict[str, float] = {'wrap': _wrap(kinds['ticks'])} if 'ticks' in kinds else {}
        self.DRIVER: dict[str, int] = (
            {'sequence_wrap': _wrap(kinds['sequence'])} if 'sequence' in kinds else {})

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """Find all readings; see `Framing.parse`."""
        readings: list[Reading] = []
        rejected: Counter[str] = Counter()
        at = frames = 0
        while True:
            start = data.find(self._sync, at)
            if start < 0:
                at = len(data) - self._partial_sync(data, at)
                break
            if start + self.size > len(data):
                at = start
                break
            cause = self._rejection_cause(data, start)
            if not cause:
                try:
                    readings += self._read(data, start)
                except fields.Rejected as error:
                    cause = str(error)
            if cause:
                rejected[f'frames {cause}'] += 1
                at = start + 1
            else:
                frames += 1
                at = start + self.size
        consumed = len(data) if final else at
        if n_outside := consumed - frames * self.size:
            rejected['bytes between frames'] = n_outside
        return Parsed(tuple(readings), consumed, rejected)

    def _partial_sync(self, data: bytes, at: int) -> int:
        """Length of the partial sync at the end of `data[at:]`; 0 without a partial sync."""
        return next((n for n in range(min(len(self._sync) - 1, len(data) - at), 0, -1)
                     if data.endswith(self._sync[:n])), 0)

    def _rejection_cause(self, data: bytes, start: int) -> str:
        """Reason why the frame at `start` is rejected; empty for a valid frame."""
        # An exception would be too slow, as this is called for every byte that looks like a sync.
        if not data.startswith(self._tail, start + self._checksum_end):
            return 'with a wrong tail'
        end = start + self._payload_end
        sent_checksum = int.from_bytes(data[end:start + self._checksum_end], self._order)
        if sent_checksum != self._compute(data[start + self._coverage_start:end]):
            return 'with a wrong checksum'
        return ''

    def _read(self, data: bytes, start: int) -> list[Reading]:
        values = self._struct.unpack_from(data, start + self._payload_start)
        return self._layout.readings(
            [convert(value) for convert, value in zip(self._converters, values, strict=True)])


def _parse_bytes(setting: str, text: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise SettingsError(
            f'{setting}: {text!r} is not hexadecimal; expected bytes such as A5 5A') from None


def _parse_fields(setting: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    out = []
    for text in texts:
        name, _, kind = text.rpartition(':')
        if kind not in _STRUCT_CODES:
            raise SettingsError(f'{setting}: {text!r}: expected a name with one of the types '
                                f'{" ".join(_STRUCT_CODES)}, such as x:i16')
        if kind[0] == 'f' and name in ('sensor', 'sequence'):
            raise SettingsError(f'{setting}: {name} must be an integer, got {kind}')
        out.append((name, kind))
    return out


def _wrap(kind: str) -> int:
    """Number at which a counter of this type wraps; 0 if it never does in practice."""
    bits = int(kind[1:])
    return 0 if kind[0] == 'f' or bits == 64 else 1 << bits


def _converter(quantity: str, kind: str, order: _ByteOrder) -> _Converter:
    if quantity == fields.SKIP:
        return fields.ignore_value
    convert: _Converter
    if quantity in fields.AXES or quantity == 'ticks':
        checked = fields.axis_value if quantity in fields.AXES else fields.ticks_value
        convert = checked if kind[0] == 'f' else float
    else:
        convert = str if quantity == 'sensor' else int
    if not kind.endswith('24'):
        return convert
    signed = kind[0] == 'i'
    return lambda raw: convert(int.from_bytes(raw, order, signed=signed))
