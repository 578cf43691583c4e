"""Fuzz test of the framings: every frame amid garbage must be found, and no false frame.

PYTHONPATH=test python -m support.framing_fuzz --frames 1000000

For each framing, the command prints the frames sent and found, the bytes of garbage and the parsing
time. It exits with 1 on any loss. To add a framing, add an entry to `CASES`.
"""

import argparse
import functools
import math
import operator
import random
import struct
import sys
import time
import zlib
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from mag_tracking.drivers.framings.binary import BinaryFraming, BinarySettings
from mag_tracking.drivers.framings.json_objects import JsonFraming, JsonSettings
from mag_tracking.drivers.framings.text import TextFraming, TextSettings
from mag_tracking.drivers.reading import Reading

GARBAGE = ('random', 'head', 'half', 'damaged')


class Case(NamedTuple):
    """A framing, and a generator of its frames."""

    make_framing: Callable
    """Function that creates the framing."""
    encode_random_frame: Callable
    """Function from a `random.Random` to (bytes, [Reading, ...])."""
    end_of_garbage: bytes = b''
    """Bytes appended to garbage, so that it does not merge with the next frame."""
    garbage: tuple = GARBAGE
    """Kinds of garbage that cannot be valid frames."""
    chance: float = 0.0
    """Probability that a false frame passes the checksum."""


class Result(NamedTuple):
    """Result of the fuzz test for one framing."""

    sent: int
    """Number of frames sent."""
    readings: int
    """Number of readings in the frames sent."""
    found: int
    """Number of readings that were found."""
    lost: int
    invented: int
    garbage: int
    """Number of bytes of garbage."""
    suspects: int
    """Number of frames with a wrong checksum."""
    seconds: float
    """Processor time for parsing."""
    worst_rest: int
    """Maximum number of unconsumed bytes."""

    def failed(self, chance):
        """Whether there are more errors than false frames with probability `chance` can explain."""
        mean = chance * self.suspects
        limit = math.floor(mean + 6.0 * math.sqrt(mean)) if mean > 0.01 else 0
        # A false frame hides at most one true frame, because all frames have the same length.
        return max(self.invented, self.lost) > limit * self.readings / self.sent


def random_garbage(rng, case, frame):
    """Generate random garbage, partly derived from `frame` (bytes)."""
    out = b''
    for _ in range(rng.randint(1, 3)):
        kind = rng.choice(case.garbage)
        if kind == 'random':
            out += rng.randbytes(rng.randint(1, 40))
        elif kind == 'head':
            out += frame[:rng.randint(1, 3)] * rng.randint(1, 8) + rng.randbytes(rng.randint(0, 3))
        elif kind == 'half':
            out += frame[:rng.randint(1, len(frame) - 2)]
        else:
            # Flipping 0x20 would give a lower-case hexadecimal digit, which is valid.
            at, flip = rng.randrange(len(frame) - 1), rng.choice((1, 2, 7, 64, 128, 255))
            out += frame[:at] + bytes([frame[at] ^ flip]) + frame[at + 1:]
        out += case.end_of_garbage
    return out


def fuzz(case, n_frames, seed=0, share=0.4):
    """Parse `n_frames` with garbage before a fraction `share` of them; return the `Result`."""
    rng, framing = random.Random(seed), case.make_framing()
    expected, sent, n_readings = deque(), 0, 0
    found = lost = invented = n_garbage = suspects = worst = 0
    seconds, rest = 0.0, b''
    while sent < n_frames or rest:
        pieces, batch = [], min(500, n_frames - sent)
        for _ in range(batch):
            frame, readings = case.encode_random_frame(rng)
            if rng.random() < share:
                garbage = random_garbage(rng, case, frame)
                n_garbage += len(garbage)
                pieces.append(garbage)
            pieces.append(frame)
            expected += [repr(reading) for reading in readings]
            n_readings += len(readings)
        sent += batch
        stream, at = b''.join(pieces), 0
        while at < len(stream) or not batch:
            piece = stream[at:at + rng.randint(1, 4000)]
            at += len(piece)
            data = rest + piece
            start = time.process_time()
            parsed = framing.parse(data, final=not batch)
            seconds += time.process_time() - start
            rest = data[parsed.consumed:]
            worst = max(worst, len(rest))
            suspects += sum(n for cause, n in parsed.rejected.items() if 'checksum' in cause)
            for reading in parsed.readings:
                skipped = _skipped(expected, repr(reading))
                if skipped is None:
                    invented += 1
                else:
                    found, lost = found + 1, lost + skipped
            if not batch:
                break
    return Result(sent, n_readings, found, lost + len(expected), invented, n_garbage, suspects,
                  seconds, worst)


def _skipped(expected, reading):
    """Remove `reading` and all readings before it from `expected`; return the number before it.

    Return None if the first 200 entries of `expected` do not contain `reading`.
    """
    for i in range(min(200, len(expected))):
        if expected[i] == reading:
            for _ in range(i + 1):
                expected.popleft()
            return i
    return None


def _axes(rng, scale, digits):
    """Random values of three axes up to +/- `scale`; in 5 % of cases, one of them is NaN."""
    axes = [round(rng.uniform(-scale, scale), digits) for _ in range(3)]
    if rng.random() < 0.05:
        axes[rng.randrange(3)] = math.nan
    return tuple(axes)


def text_frame(rng):
    """Random frame $MAG,sensor,sequence,ticks,x,y,z*hh for `text_framing`, and its readings."""
    sensor, axes = rng.choice(('A', 'B7', 'north', 'ß')), _axes(rng, 6e4, 2)
    sequence, ticks = rng.randrange(1 << 32), rng.randrange(1 << 40)
    numbers = ','.join(rng.choice(('', 'nan')) if math.isnan(v) else str(v) for v in axes)
    body = f'MAG,{sensor},{sequence},{ticks},{numbers}'.encode()
    checksum = functools.reduce(operator.xor, body)
    return (b'$%s*%02X\n' % (body, checksum),
            [Reading(sensor, axes, None, float(ticks), sequence)])


def text_framing():
    """Create the framing of `text_frame`."""
    return TextFraming(TextSettings(fields=('sensor', 'sequence', 'ticks', 'x', 'y', 'z'),
                                    prefix='$MAG,', checksum='nmea', max_length=120))


def json_frame(rng):
    """Random line {"id", "n", "t", "mag", "acc"} for `json_framing`, and its readings."""
    sensor, axes, acceleration = rng.choice('ABC'), _axes(rng, 6e4, 2), _axes(rng, 20.0, 3)
    sequence, ticks = rng.randrange(1 << 32), rng.random() * 1e6
    x, y, z = ('null' if math.isnan(v) else str(v) for v in axes)
    a = ', '.join('NaN' if math.isnan(v) else str(v) for v in acceleration)
    line = (f'{{"id": "{sensor}", "mag": {{"x":{x}, "y":{y}, "z":{z}}}, "t": {ticks!r}, '
            f'"acc": [{a}], "n": {sequence}}}\n')
    return line.encode(), [Reading(sensor, axes, acceleration, ticks, sequence)]


def json_framing():
    """Create the framing of `json_frame`."""
    return JsonFraming(JsonSettings(sensor='id', ticks='t', sequence='n', acceleration=('acc',),
                                    field=('mag.x', 'mag.y', 'mag.z'), max_length=256))


def binary_frame(rng):
    """Random frame A5 5A, u16, u32, three f32, CRC-32 for `binary_framing`, and its reading."""
    sequence, ticks = rng.randrange(1 << 16), rng.choice((rng.randrange(1 << 32), 0x5AA55AA5))
    packed = struct.pack('<3f', *_axes(rng, 6e4, 2))
    payload = struct.pack('<HI', sequence, ticks) + packed
    frame = b'\xA5\x5A' + payload + struct.pack('<I', zlib.crc32(payload))
    return frame, [Reading('', struct.unpack('<3f', packed), None, float(ticks), sequence)]


def binary_framing():
    """Create the framing of `binary_frame`."""
    return BinaryFraming(BinarySettings(
        sync='A5 5A', fields=('sequence:u16', 'ticks:u32', 'x:f32', 'y:f32', 'z:f32'),
        checksum='crc32'))


@functools.cache
def _eight_steps(crc):
    """Update a CRC-16/MODBUS with eight zero bits."""
    for _ in range(8):
        crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def board_frame(rng):
    """Random frame FF, u8, four sensors of three i24, CRC-16, 0D, big endian, and its readings."""
    sequence = rng.randrange(256)
    # The CRC includes the sync byte, and many bytes equal the sync byte.
    counts = [tuple(rng.choice((-1, -256, 255, rng.randrange(-1 << 23, 1 << 23)))
                    for _ in range(3)) for _ in range(4)]
    covered = bytes([0xFF, sequence]) + b''.join(
        v.to_bytes(3, 'big', signed=True) for triple in counts for v in triple)
    crc = functools.reduce(lambda crc, byte: _eight_steps(crc ^ byte), covered, 0xFFFF)
    frame = covered + crc.to_bytes(2, 'big') + b'\r'
    return frame, [Reading(str(i), tuple(map(float, triple)), None, None, sequence)
                   for i, triple in enumerate(counts)]


def board_framing():
    """Create the framing of `board_frame`."""
    return BinaryFraming(BinarySettings(
        sync='FF', fields=('sequence:u8',), each=('x:i24', 'y:i24', 'z:i24'), count=4, tail='0D',
        byte_order='big', checksum='crc16_modbus', checksum_from='sync'))


CASES = {
    'text': Case(text_framing, text_frame, b'\n'),
    'json': Case(json_framing, json_frame, b'\n', ('random', 'head', 'half')),
    'binary': Case(binary_framing, binary_frame),
    'binary of a board': Case(board_framing, board_frame, chance=2.0**-16),
}
"""{printed name: case}."""


def main():
    """Run the command; return 1 if any framing fails, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--frames', type=int, default=20_000, help='number of frames per framing')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', choices=CASES, help='test only this framing')
    arguments = parser.parse_args()
    failed = False
    for name, case in CASES.items():
        if arguments.only not in (None, name):
            continue
        result = fuzz(case, arguments.frames, arguments.seed)
        bad = result.failed(case.chance)
        failed |= bad
        print(f'{name}: {result.sent} frames sent, {result.found} readings found, '
              f'{result.lost} lost, {result.invented} invented, {result.garbage} bytes of garbage, '
              f'{result.suspects} wrong checksums, at most {result.worst_rest} unconsumed bytes, '
              f'{result.seconds:.2f} s{": FAILED" if bad else ""}', flush=True)
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
