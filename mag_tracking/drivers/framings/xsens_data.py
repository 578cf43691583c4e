"""Decoding of the Xsens data messages MTData2 and MTData.

The magnetic field is in arbitrary units (1 is the magnitude of the field where Xsens calibrated the
sensor), the acceleration in m/s². Both are in the sensor frame: the coordinate bits of a data
identifier (0x4 NED, 0x8 NWU) apply to the orientation only (MT0101P, note to revision W) and are
ignored.

Sources: Xsens, "MT Low Level Communication Protocol Documentation", MT0101P, revision 2019.A:
MTData2, the table of its data identifiers, and the fixed point formats; Xsens, "MTi and MTx User
Manual and Technical Documentation", MT0100P.N, section 5.3: SetOutputSettings and MTData.
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

from mag_tracking.drivers.reading import Reading
from mag_tracking.errors import SettingsError

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


_Triple: TypeAlias = tuple[float, float, float]


class DecodedMessage(NamedTuple):
    """Reading of a data message, and the causes for which data were ignored."""

    reading: Reading | None
    """None if the message has neither field nor acceleration."""
    causes: tuple[str, ...]
    """One cause for each occurrence of ignored data."""


def _three_reals(data: bytes, precision: int) -> _Triple | None:
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


def _decode_packet(identifier: int, data: bytes) -> tuple[str, float | _Triple | None] | None:
    """Decode a packet into (attribute of `Reading`, value), None if it is not used.

    The value is None if the length of the packet is wrong.
    """
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
    """Decode DATA of an MTData2 message; None if the packets do not fill it, or a used one has an
    invalid length.

    A packet is an identifier (u16), the length of its data (u8), and the data. Unused packets are
    counted only if they contain raw values (0xA0..) or other magnetic data (0xC0..).
    SampleTimeCoarse (0x1070) is too coarse for a clock.
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
    """Create a message from {attribute of `Reading`: value}; without field and acceleration, it has
    no reading."""
    if 'field' in values or 'acceleration' in values:
        return DecodedMessage(Reading(**values), tuple(causes))
    return DecodedMessage(None, (*causes, 'messages without field or acceleration'))


class MTDataLayout:
    """Layout of MTData messages, which do not describe it, so that it must be configured.

    `blocks`, in this order: 'temp', 'acc', 'gyr', 'mag', one of 'quaternion', 'euler' and 'matrix',
    'analog_1', 'analog_2', 'status', 'counter'. `number_format` of all real numbers is 'float' or
    'fp12.20'. `size` is the length of DATA in bytes. Raises SettingsError if a block is unknown or
    out of order, there are several orientations, or neither 'acc' nor 'mag'.
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
