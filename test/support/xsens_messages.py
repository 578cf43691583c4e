"""Messages of a simulated Xsens device, according to the protocol and independent of the parser.

For a long fuzz test, run `PYTHONPATH=test python -m support.xsens_messages --frames 1000000`.
"""

import argparse
import random
import struct
import time

from mag_tracking.drivers.reading import Reading

LAYOUT = ('temp', 'acc', 'gyr', 'mag', 'counter')
"""Blocks of the MTData messages of `encode_random_frame`, in float precision."""
FLOAT, FP1220, FP1632, DOUBLE = range(4)
FREQUENT_BYTES = (0xFA, 0xFA, 0xFF, 0xFF, 0x36, 0x32, 0x3E)
"""Bytes that are frequent in garbage."""


def message(mid, data, extended=None):
    """Encode a message; if `extended` (default: if necessary), its length takes two more bytes."""
    if extended is None:
        extended = len(data) > 254
    length = b'\xff' + struct.pack('>H', len(data)) if extended else bytes([len(data)])
    body = b'\xff' + bytes([mid]) + length + bytes(data)
    return b'\xfa' + body + bytes([-sum(body) & 0xFF])


def packet(identifier, data):
    """Encode a packet of MTData2."""
    return struct.pack('>HB', identifier, len(data)) + data


def reals(numbers, precision):
    """Encode real numbers in a given precision."""
    if precision == FLOAT:
        return struct.pack(f'>{len(numbers)}f', *numbers)
    if precision == DOUBLE:
        return struct.pack(f'>{len(numbers)}d', *numbers)
    if precision == FP1220:
        return b''.join(int(x * 2**20).to_bytes(4, 'big', signed=True) for x in numbers)
    out = b''
    for x in numbers:
        fixed_point = int(x * 2**32).to_bytes(6, 'big', signed=True)
        out += fixed_point[2:] + fixed_point[:2]
    return out


def mtdata2(reading, precision=FLOAT, before=b'', behind=b''):
    """Encode an MTData2 message of a reading, with other packets before and after it."""
    data = before
    if reading.sequence is not None:
        data += packet(0x1020, struct.pack('>H', reading.sequence))
    if reading.ticks is not None:
        data += packet(0x1060, struct.pack('>I', int(reading.ticks)))
    if reading.acceleration is not None:
        data += packet(0x4020 + precision, reals(reading.acceleration, precision))
    if reading.field is not None:
        data += packet(0xC020 + precision, reals(reading.field, precision))
    return message(0x36, data + behind)


READING = Reading('', (0.25, -1.5, 0.125), (0.5, -0.75, 9.8125), 5719854.0, 42581)
FRAME = mtdata2(READING)


def random_reals(rng, precision, n=3):
    """Random numbers that `precision` represents exactly."""
    bits, fraction = {FLOAT: (25, 20), FP1220: (32, 20), FP1632: (48, 32), DOUBLE: (53, 40)}[
        precision]
    return tuple((rng.getrandbits(bits) - 2**(bits - 1)) / 2**fraction for _ in range(n))


def random_reading(rng, precision):
    """Random reading with field, acceleration or both."""
    kind = rng.randrange(4)
    return Reading(
        field=None if kind == 0 else random_reals(rng, precision),
        acceleration=None if kind == 1 else random_reals(rng, precision),
        ticks=float(rng.getrandbits(32)) if rng.random() < 0.8 else None,
        sequence=rng.getrandbits(16) if rng.random() < 0.8 else None)


def other_packet(rng):
    """Random packet that is not part of a reading, of a known or unknown type."""
    kind, size = rng.choice(((0x0810, 4), (0x1010, 12), (0x1070, 4), (0x2010, 16), (0x2034, 12),
                             (0x4010, 12), (0x4030, 12), (0x8020, 12), (0xE020, 4),
                             (0x5A5F, rng.randrange(40)), (0xFAFF, rng.randrange(40))))
    return packet(kind, rng.randbytes(size))


def encode_random_frame(rng):
    """Random message of a device, as (bytes, [Reading]); `rng` is a random.Random."""
    kind = rng.random()
    if kind < 0.08:
        mid, size = rng.choice(((0x3E, 0), (0x42, 1), (0x31, 0), (0x0D, 118), (0xC1, 32),
                                (0x01, 4), (0x63, 110)))
        return message(mid, rng.randbytes(size)), []
    if kind < 0.25:
        field, acceleration = random_reals(rng, FLOAT), random_reals(rng, FLOAT)
        count = rng.getrandbits(16)
        data = (rng.randbytes(4) + reals(acceleration, FLOAT) + rng.randbytes(12)
                + reals(field, FLOAT) + struct.pack('>H', count))
        return message(0x32, data), [Reading('', field, acceleration, None, count)]
    precision = rng.randrange(4)
    reading = random_reading(rng, precision)
    others = [b''.join(other_packet(rng) for _ in range(rng.randrange(4))) for _ in range(2)]
    return mtdata2(reading, precision, *others), [reading]


def garbage(rng, n):
    """Generate `n` random bytes that resemble beginnings of messages."""
    out = bytearray()
    while len(out) < n:
        kind = rng.random()
        if kind < 0.3:
            out += b'\xfa\xff' + bytes([rng.choice((0x36, 0x36, 0x32, 0x0D)), rng.getrandbits(8)])
        elif kind < 0.35:
            out += b'\xfa\xff\x36\xff' + struct.pack('>H', rng.randrange(600))
        elif kind < 0.6:
            out.append(rng.choice(FREQUENT_BYTES))
        else:
            out.append(rng.getrandbits(8))
    return bytes(out[:n])


def stream(rng, frames):
    """Random frames with garbage in between: (bytes, [Reading], lengths of the frames)."""
    parts, readings, lengths = [], [], []
    for _ in range(frames):
        if rng.random() < 0.5:
            parts.append(garbage(rng, rng.randrange(30)))
        data, new = encode_random_frame(rng)
        parts.append(data)
        lengths.append(len(data))
        readings += new
    return b''.join(parts), readings, lengths


def lost_and_false(sent, found):
    """Compare two sequences in order: (number of lost readings, number of false readings)."""
    lost = position = false = 0
    at = {}
    for index, reading in enumerate(sent):
        at.setdefault(repr(reading), []).append(index)
    for reading in found:
        matches = [i for i in at.get(repr(reading), ()) if i >= position]
        if matches:
            lost += matches[0] - position
            position = matches[0] + 1
        else:
            false += 1
    return lost + len(sent) - position, false


def main():
    """Parse many frames in pieces of 64 bytes, as from a serial port; print the errors and the
    time."""
    from mag_tracking.drivers.framings.xsens import XsensFraming, XsensSettings

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--frames', type=int, default=1_000_000)
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    rng, framing = random.Random(arguments.seed), XsensFraming(XsensSettings(mtdata=LAYOUT))
    sent = lost = false = n_bytes = 0
    parse_s = 0.0
    for _ in range(0, arguments.frames, 10_000):
        data, readings, _ = stream(rng, min(10_000, arguments.frames))
        found, rest, position = [], b'', 0
        begin = time.perf_counter()
        while position < len(data):
            piece = rest + data[position:position + 64]
            position += 64
            parsed = framing.parse(piece, final=position >= len(data))
            rest = piece[parsed.consumed:]
            found += parsed.readings
        parse_s += time.perf_counter() - begin
        n_lost, n_false = lost_and_false(readings, found)
        sent, lost, false, n_bytes = (sent + len(readings), lost + n_lost, false + n_false,
                                      n_bytes + len(data))
    print(f'{arguments.frames} frames with {sent} readings in {n_bytes} bytes: {lost} lost, '
          f'{false} false, {1e6 * parse_s / arguments.frames:.1f} us a frame')


if __name__ == '__main__':
    main()
