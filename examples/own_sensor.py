"""A sensor that speaks a protocol of its own: all that a driver of yours has to say.

This one sends packets between bytes C0 (SLIP, RFC 1055): a count, microseconds and three numbers
of 24 bits in units of 10 nT, with the sum of all bytes behind them. In a drivers file:

    mine:
      transport: serial
      serial: {port: /dev/ttyUSB0}
      framing: own_sensor:SlipFraming     # module:Class; the module has to be importable
      framing_settings: {sensor: north}
      unit: '1e-8'
      sensors: {north: mag_1}

Run as a program it writes some packets with garbage between them, and reads them.
"""

import struct
from collections import Counter
from dataclasses import dataclass

from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.settings import param

END, ESCAPE = b'\xc0', b'\xdb'
LONGEST = 2 * 16
"""A packet in which every byte is escaped."""


@dataclass(frozen=True)
class SlipSettings:
    """Settings, as they stand under `framing_settings`."""

    sensor: str = param('', 'Its name, for the list of sensors.')


class SlipFraming:
    """Finds packets in bytes. It holds settings and nothing that it has seen: see `Framing`."""

    SETTINGS = SlipSettings
    # What every device of this kind has in common; a drivers file may say otherwise.
    CLOCK = {'tick_s': 1e-6, 'wrap': 2**32}
    DRIVER = {'sequence_wrap': 2**16}

    def __init__(self, settings):
        self._sensor = settings.sensor

    def parse(self, data, final=False):
        """All readings in `data`; what may be the beginning of a packet stays for the next time."""
        *packets, rest = data.split(END)
        rejected, readings = Counter(), []
        for packet in packets:
            self._read(packet, readings, rejected)
        # Longer than any packet, or nothing follows: it will never be one.
        if rest and (final or len(rest) > LONGEST):
            rejected['bytes between frames'] += len(rest)
            rest = b''
        return Parsed(tuple(readings), len(data) - len(rest), rejected)

    def _read(self, packet, readings, rejected):
        """One packet: a reading, or why it is none."""
        plain = packet.replace(ESCAPE + b'\xdc', END).replace(ESCAPE + b'\xdd', ESCAPE)
        if not plain:
            return
        if len(plain) != 16:
            rejected['bytes between frames'] += len(packet)
        elif sum(plain[:-1]) % 256 != plain[-1]:
            rejected['frames with a wrong checksum'] += 1
        else:
            count, microseconds = struct.unpack_from('<HI', plain)
            field = tuple(float(int.from_bytes(plain[k:k + 3], 'little', signed=True))
                          for k in (6, 9, 12))
            readings.append(Reading(self._sensor, field, None, microseconds, count))


def packet_of(count, microseconds, field):
    """What the sensor sends; for the demonstration."""
    plain = struct.pack('<HI', count, microseconds) + b''.join(
        v.to_bytes(3, 'little', signed=True) for v in field)
    plain += bytes([sum(plain) % 256])
    return plain.replace(ESCAPE, ESCAPE + b'\xdd').replace(END, ESCAPE + b'\xdc') + END


def main():
    """Three packets between garbage."""
    framing = SlipFraming(SlipSettings(sensor='north'))
    stream = b'half a pack' + END + b''.join(
        packet_of(k, 10_000 * k, (200 + k, 1550, -4900)) + b'garbage' + END for k in range(3))
    parsed = framing.parse(stream)
    for reading in parsed.readings:
        print(reading)
    print(f'{len(parsed.readings)} readings; rejected: {dict(parsed.rejected)}')


if __name__ == '__main__':
    main()
