"""Driver for a sensor with its own protocol: complete code of a custom framing.

The sensor sends packets delimited by bytes C0 (SLIP, RFC 1055): a counter, a time in microseconds,
three 24-bit values in units of 10 nT, and the sum of all bytes as checksum. In a drivers file:

    mine:
      transport: serial
      serial: {port: /dev/ttyUSB0}
      framing: own_sensor:SlipFraming     # module:Class; the module must be importable
      framing_settings: {sensor: north}
      unit: '1e-8'
      sensors: {north: mag_1}

Run as a program, this file parses a demonstration stream of packets with garbage between them.
"""

import struct
from collections import Counter
from dataclasses import dataclass

from mag_tracking.drivers.reading import Parsed, Reading
from mag_tracking.settings import param

END, ESCAPE = b'\xc0', b'\xdb'
MAX_PACKET_BYTES = 2 * 16
"""Maximum length of a packet, in which every byte is escaped [bytes]."""


@dataclass(frozen=True)
class SlipSettings:
    """Settings, listed under `framing_settings` in the drivers file."""

    sensor: str = param('', 'Name of the sensor: its key in `sensors` of the drivers file.')


class SlipFraming:
    """Extracts readings from a byte stream. It has settings but no state; see `Framing`."""

    SETTINGS = SlipSettings
    # Defaults for every device of this kind; a drivers file may override them.
    CLOCK = {'tick_s': 1e-6, 'wrap': 2**32}
    DRIVER = {'sequence_wrap': 2**16}

    def __init__(self, settings):
        self._sensor = settings.sensor

    def parse(self, data, final=False):
        """Parse all readings in `data`; an incomplete packet at the end remains unconsumed.
        """
        *packets, rest = data.split(END)
        rejected, readings = Counter(), []
        for packet in packets:
            self._read(packet, readings, rejected)
        # The remaining bytes cannot become a packet if they are too long, or if no bytes follow.
        if rest and (final or len(rest) > MAX_PACKET_BYTES):
            rejected['bytes between frames'] += len(rest)
            rest = b''
        return Parsed(tuple(readings), len(data) - len(rest), rejected)

    def _read(self, packet, readings, rejected):
        """Add the reading of a packet, or count the rejected packet by cause."""
        payload = packet.replace(ESCAPE + b'\xdc', END).replace(ESCAPE + b'\xdd', ESCAPE)
        if not payload:
            return
        if len(payload) != 16:
            rejected['bytes between frames'] += len(packet)
        elif sum(payload[:-1]) % 256 != payload[-1]:
            rejected['frames with a wrong checksum'] += 1
        else:
            count, microseconds = struct.unpack_from('<HI', payload)
            field = tuple(float(int.from_bytes(payload[k:k + 3], 'little', signed=True))
                          for k in (6, 9, 12))
            readings.append(Reading(self._sensor, field, None, microseconds, count))


def packet_of(count, microseconds, field):
    """Encode a packet in the format of the sensor."""
    payload = struct.pack('<HI', count, microseconds) + b''.join(
        v.to_bytes(3, 'little', signed=True) for v in field)
    payload += bytes([sum(payload) % 256])
    return payload.replace(ESCAPE, ESCAPE + b'\xdd').replace(END, ESCAPE + b'\xdc') + END


def main():
    """Parse three packets separated by garbage, and print the readings and rejections."""
    framing = SlipFraming(SlipSettings(sensor='north'))
    stream = b'half a pack' + END + b''.join(
        packet_of(k, 10_000 * k, (200 + k, 1550, -4900)) + b'garbage' + END for k in range(3))
    parsed = framing.parse(stream)
    for reading in parsed.readings:
        print(reading)
    print(f'{len(parsed.readings)} readings; rejected: {dict(parsed.rejected)}')


if __name__ == '__main__':
    main()
