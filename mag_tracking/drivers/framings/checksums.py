"""Checksums of the frames sent by devices.

Source of the names, polynomials and check values: "Catalogue of parametrised CRC algorithms" (G.
Cook). The check value is the checksum of the ASCII string '123456789'.
"""

import binascii
import zlib
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import NamedTuple


class Checksum(NamedTuple):
    """Checksum algorithm: length of the checksum, and function that computes it."""

    size: int
    """Length in bytes."""
    compute: Callable[[bytes], int]
    """Function that computes the checksum of the covered bytes."""


def sum8(data: bytes) -> int:
    """Sum of the bytes modulo 256; check value 0xDD."""
    return sum(data) & 0xFF


def xor8(data: bytes) -> int:
    """Exclusive or of the bytes, as in NMEA 0183; check value 0x31."""
    return reduce(xor, data, 0)


def _forward_table(polynomial: int) -> tuple[int, ...]:
    """Table of the 8-bit CRC of each byte value, most significant bit first; `polynomial` with its
    x^8."""
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte << 1 ^ (polynomial if byte & 0x80 else 0)
        table.append(byte & 0xFF)
    return tuple(table)


def _reflected_table(polynomial: int) -> tuple[int, ...]:
    """Table of the CRC of each byte value, least significant bit first; `polynomial` is reversed
    too."""
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (polynomial if byte & 1 else 0)
        table.append(byte)
    return tuple(table)


_CRC8_TABLE = _forward_table(0x107)
_MODBUS_TABLE = _reflected_table(0xA001)


def crc8(data: bytes) -> int:
    """CRC-8/SMBUS: polynomial 0x07, initial value 0; check value 0xF4."""
    crc, table = 0, _CRC8_TABLE
    for byte in data:
        crc = table[crc ^ byte]
    return crc


def crc16_ccitt(data: bytes) -> int:
    """CRC-16/CCITT-FALSE (IBM-3740): polynomial 0x1021, initial value 0xFFFF; check value
    0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0x8005, reflected, initial value 0xFFFF; check value 0x4B37."""
    crc, table = 0xFFFF, _MODBUS_TABLE
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc


def crc32(data: bytes) -> int:
    """CRC-32 (ISO-HDLC), as in Ethernet and zip; check value 0xCBF43926."""
    return zlib.crc32(data)


CHECKSUMS = {
    'sum8': Checksum(1, sum8),
    'xor8': Checksum(1, xor8),
    'crc8': Checksum(1, crc8),
    'crc16_ccitt': Checksum(2, crc16_ccitt),
    'crc16_modbus': Checksum(2, crc16_modbus),
    'crc32': Checksum(4, crc32),
}
"""Checksums by their names in the settings."""
