"""Binary framing, checksums, field layouts, and properties that every framing has."""

import math
import random
import struct
import time
import zlib
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.drivers.framings.binary import CHECKSUMS, BinaryFraming, BinarySettings
from mag_tracking.drivers.framings.fields import FieldLayout, decode_escapes
from mag_tracking.drivers.framings.json_objects import JsonFraming, JsonSettings
from mag_tracking.drivers.framings.text import TextFraming, TextSettings
from mag_tracking.drivers.reading import Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import replace
from support.counters import assert_counts, count_of
from support.framing_fuzz import CASES, fuzz, random_garbage

XYZ = ('x', 'y', 'z')
XYZ_I16 = ('x:i16', 'y:i16', 'z:i16')
READING = Reading('', (1.0, 2.0, 3.0))


def binary(**changes):
    return BinaryFraming(replace(BinarySettings(), {
        'sync': 'A5 5A', 'fields': XYZ_I16, **changes}))


# Checksums.

@pytest.mark.parametrize('name, value', [
    ('sum8', 0xDD), ('xor8', 0x31), ('crc8', 0xF4), ('crc16_ccitt', 0x29B1),
    ('crc16_modbus', 0x4B37), ('crc32', 0xCBF43926)])
def test_checksums_have_their_check_values(name, value):
    size, function = CHECKSUMS[name]
    assert function(b'123456789') == value
    assert function(bytes(range(256)) * 3) < 256**size


# Fields.

@pytest.mark.parametrize('fields, each, count, values, expected', [
    (XYZ, (), 0, [1.0, 2.0, 3.0], [READING]),
    (('z', '-', 'x', '-'), (), 0, [3.0, None, 1.0, None], [Reading('', (1.0, math.nan, 3.0))]),
    (('ticks', 'ay'), (), 0, [9.0, 2.0],
     [Reading('', None, (math.nan, 2.0, math.nan), 9.0)]),
    (('sensor', 'x', 'y', 'z', 'ax', 'ay', 'az', 'sequence'), (), 0,
     ['S', 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7],
     [Reading('S', (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), None, 7)]),
    (('y.B', 'x.A', 'sequence', 'x.B', 'ax.A.1'), (), 0, [1.0, 2.0, 7, 3.0, 4.0],
     [Reading('B', (3.0, 1.0, math.nan), None, None, 7),
      Reading('A', (2.0, math.nan, math.nan), None, None, 7),
      Reading('A.1', None, (4.0, math.nan, math.nan), None, 7)]),
    (('sensor', 'x.A'), ('z', '-', 'y'), 2, ['board', 1.0, 2.0, None, 3.0, 4.0, None, 5.0],
     [Reading('board.A', (1.0, math.nan, math.nan)), Reading('board.0', (math.nan, 3.0, 2.0)),
      Reading('board.1', (math.nan, 5.0, 4.0))])])
def test_field_layouts_map_values_to_readings(fields, each, count, values, expected):
    layout = FieldLayout(fields, each, count)
    assert len(layout.quantities) == len(values)
    assert repr(layout.readings(values)) == repr(expected)


@pytest.mark.parametrize('fields, each, count, message', [
    ((), (), 0, 'x y z ax'),
    (('ticks', '-'), (), 0, 'x y z ax'),
    (('x', 'w'), (), 0, "fields: 'w': "),
    (('x', 'y', 'x'), (), 0, 'x appears'),
    (('x.A', 'x.A'), (), 0, 'x.A appears'),
    (('ticks', 'ticks', 'x'), (), 0, 'ticks appears'),
    (('x.0',), ('x',), 1, 'x.0 appears twice'),
    (('x', 'y.A'), (), 0, 'all axes'),
    (('x',), ('y',), 1, 'all axes'),
    (('x', 'ticks.A'), (), 0, "fields: 'ticks.A': "),
    (('x', '-.A'), (), 0, "fields: '-.A': "),
    (('x.',), (), 0, '1 to 64 printable'),
    (('x.' + 65 * 'a',), (), 0, '1 to 64 printable'),
    (('x.\n',), (), 0, '1 to 64 printable'),
    ((), ('x', 'ticks'), 2, "each: .*'ticks'"),
    ((), ('x.A',), 2, "each: .*'x.A'"),
    ((), ('x',), 0, 'together'),
    (XYZ, (), 3, 'together')])
def test_invalid_field_layouts_are_refused(fields, each, count, message):
    with pytest.raises(SettingsError, match=message):
        FieldLayout(fields, each, count)


def test_a_sensor_name_may_have_64_characters():
    assert FieldLayout(('x.' + 64 * 'a',)).readings([1.0])[0].sensor == 64 * 'a'


def test_escapes_are_equal_in_single_and_double_quotes_of_yaml():
    assert decode_escapes('end', '\\r\\n') == decode_escapes('end', '\r\n') == b'\r\n'
    assert decode_escapes('end', '\\t\\0\\x1e\\\\n') == b'\t\x00\x1e\\n'
    for bad in ('\\q', '\\', '\\x80', '\\x1', '\ud800'):
        with pytest.raises(SettingsError, match='end'):
            decode_escapes('end', bad)


# Binary.

LIMITS = {'u8': (0, 255), 'i8': (-128, 127), 'u16': (0, 65535), 'i16': (-32768, 32767),
          'u24': (0, 2**24 - 1), 'i24': (-2**23, 2**23 - 1), 'u32': (0, 2**32 - 1),
          'i32': (-2**31, 2**31 - 1), 'u64': (0, 2**64 - 1), 'i64': (-2**63, 2**63 - 1)}


@pytest.mark.parametrize('order', ['little', 'big'])
@pytest.mark.parametrize('kind', LIMITS)
def test_every_integer_type_is_decoded(kind, order):
    low, high = LIMITS[kind]
    values = (low, high, 1)
    payload = b''.join(v.to_bytes(int(kind[1:]) // 8, order, signed=low < 0)
                       for v in (*values, high, high, low, 5))
    fields = ['x', 'y', 'z', 'sequence', '-', 'ticks', 'sensor']
    framing = binary(sync='01', byte_order=order, fields=[f'{name}:{kind}' for name in fields])
    parsed = framing.parse(b'\x01' + payload)
    assert parsed.readings == (
        Reading('5', tuple(map(float, values)), None, float(low), high),)
    reading = parsed.readings[0]
    assert [type(v) for v in (*reading.field, reading.ticks)] == [float] * 4
    assert framing.size == parsed.consumed == len(payload) + 1


@pytest.mark.parametrize('kind, code', [('f32', 'f'), ('f64', 'd')])
def test_infinite_floats_are_rejected_and_nan_axes_are_kept(kind, code):
    framing = binary(fields=[f'{name}:{kind}' for name in ('x', 'y', 'z', 'ticks', '-')],
                     byte_order='big')

    def parse(*values):
        return framing.parse(b'\xA5\x5A' + struct.pack(f'>5{code}', *values))

    nan = math.nan
    assert repr(parse(nan, -1.5, 0, 2, math.inf).readings) == repr(
        (Reading('', (nan, -1.5, 0.0), None, 2.0),))
    for values, cause in (((1, 2, -math.inf, 4, 5), 'with an infinite number'),
                          ((1, 2, 3, math.inf, 5), 'with an infinite number'),
                          ((1, 2, 3, nan, 5), 'without ticks')):
        parsed = parse(*values)
        assert not parsed.readings and parsed.rejected[f'frames {cause}'] == 1
        assert count_of(parsed.rejected, 'between') == framing.size == parsed.consumed


@pytest.mark.parametrize('name', ['none', *CHECKSUMS])
@pytest.mark.parametrize('order', ['little', 'big'])
@pytest.mark.parametrize('start', ['sync', 'payload'])
def test_checksum_and_tail_are_checked(name, order, start):
    framing = binary(checksum=name, byte_order=order, checksum_from=start, tail='0D 0A')
    sync, payload = b'\xA5\x5A', b''.join(v.to_bytes(2, order) for v in (1, 2, 3))
    checksum = b''
    if name != 'none':
        size, function = CHECKSUMS[name]
        checksum = function((sync if start == 'sync' else b'') + payload).to_bytes(size, order)
    frame = sync + payload + checksum + b'\r\n'
    assert framing.parse(frame).readings == (READING,) and framing.size == len(frame)
    for at in range(2, len(frame)):
        bad = framing.parse(frame[:at] + bytes([frame[at] ^ 1]) + frame[at + 1:])
        if at >= len(frame) - 2:
            assert count_of(bad.rejected, 'tail') == 1 and not bad.readings
        elif name != 'none':
            assert count_of(bad.rejected, 'checksum') == 1 and not bad.readings
        else:
            assert bad.readings != (READING,)


def test_a_false_sync_hides_no_frame():
    framing = binary(checksum='crc32', sync='A5 A5', each=['x:i16', 'y:i16'], count=2,
                     fields=['sequence:u16', '-:u24'])
    payload = b'\xA5' * 13
    frame = b'\xA5\xA5' + payload + zlib.crc32(payload).to_bytes(4, 'little')
    for before in (b'', b'\xA5', b'\xA5\xA5', frame[:7], frame[:-1], b'\x00', b'\xA5\x00'):
        parsed = framing.parse(before + frame + frame + b'\x00\xA5')
        assert len(parsed.readings) == 4 and parsed.consumed == len(before + frame + frame) + 1
        assert count_of(parsed.rejected, 'between') == len(before) + 1


def test_wraps_follow_from_the_field_types():
    wraps = {}
    for kind in ('u8', 'u24', 'u32', 'u64', 'f64'):
        framing = binary(fields=[f'ticks:{kind}', 'x:i16'])
        wraps[kind] = framing.CLOCK['wrap']
        assert framing.DRIVER == {}
    assert wraps == {'u8': 256, 'u24': 2**24, 'u32': 2**32, 'u64': 0, 'f64': 0}
    framing = binary(fields=['sequence:u16', 'x:i16'])
    assert framing.DRIVER == {'sequence_wrap': 65536} and framing.CLOCK == {}


@pytest.mark.parametrize('changes, message', [
    ({'sync': ''}, 'sync: '), ({'sync': 'A5 5'}, "sync: 'A5 5'"),
    ({'sync': 'xy'}, 'sync'), ({'tail': '0'}, "tail: '0'"),
    ({'fields': ['x']}, "fields: 'x': "),
    ({'fields': ['x:u12']}, "fields: 'x:u12': "),
    ({'each': ['x.A'], 'count': 1}, "each: 'x.A': "),
    ({'fields': ['w:u8']}, "fields: 'w': "), ({'fields': []}, 'fields'),
    ({'fields': ['sequence:f32', 'x:u8']}, 'sequence must'),
    ({'fields': ['sensor:f64', 'x:u8']}, 'sensor must'),
    ({'byte_order': 'middle'}, 'byte_order'), ({'checksum': 'md5'}, 'checksum'),
    ({'checksum_from': 'tail'}, 'checksum_from'), ({'count': -1}, 'count')])
def test_invalid_binary_settings_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        binary(**changes)


# Properties of every framing.

FRAMINGS = {
    **{name: (case.make_framing(), None) for name, case in CASES.items()},
    'short lines': (TextFraming(TextSettings(fields=XYZ, max_length=12, comment='#')), (
        b'1,2,3', b'4,5,6\r', b'\n', b'\n', b'123,4567,890', b'1234,5678,90\r', b'9' * 12,
        b'\xc3', b'\xa9', b'\r', b'#', b' ')),
    'lines with a long end': (TextFraming(TextSettings(fields=XYZ, max_length=8, end='\r\n\r')), (
        b'1,2,3', b'\r', b'\n', b'\r\n\r', b'12345678', b'\r\n')),
    'objects': (JsonFraming(JsonSettings(field=('m',), max_length=24)), (
        b'{"m":[1,2,3]}', b'{"m":[4,null,6]}', b'\n', b'\n', b'\xff', b'[', b'1', b' ' * 11)),
    'no checksum': (BinaryFraming(BinarySettings(sync='01 01 02', fields=('x:i8', 'y:i16'))), (
        b'\x01', b'\x01\x01', b'\x02', b'\x03', b'\x01\x01\x02abc')),
    'tail': (BinaryFraming(BinarySettings(sync='01', fields=('x:f32',), tail='02')), (
        b'\x01', b'\x02', b'\x01\x00\x00\x80\x7f\x02', b'\x01\x00\x00\x80\x3f\x02')),
}
MAX_UNCONSUMED = {'text': 121, 'json': 257, 'binary': 24, 'binary of a board': 41,
                  'short lines': 13, 'lines with a long end': 11, 'objects': 25, 'no checksum': 6,
                  'tail': 6}


def random_stream(name, seed):
    """Random stream of pieces that are difficult for the framing `name`."""
    rng, atoms = random.Random(seed), FRAMINGS[name][1]
    if atoms:
        return b''.join(rng.choices(atoms, k=rng.randint(0, 40)))
    out, case = b'', CASES[name]
    for _ in range(rng.randint(0, 6)):
        frame = case.encode_random_frame(rng)[0]
        out += random_garbage(rng, case, frame) + frame
    return out[rng.randint(0, 20):-rng.randint(1, 20)]


def parse_pieces(name, pieces, final):
    """Parse a stream in pieces; return (readings, counts, unconsumed bytes)."""
    framing = FRAMINGS[name][0]
    readings, counts, rest = [], Counter(), b''
    for i, piece in enumerate(pieces):
        data, last = rest + piece, final and i == len(pieces) - 1
        parsed = framing.parse(data, last)
        assert repr(framing.parse(data, last)) == repr(parsed)
        assert 0 <= parsed.consumed <= len(data)
        assert all(count > 0 for count in parsed.rejected.values())
        readings += map(repr, parsed.readings)
        counts.update(parsed.rejected)
        rest = data[parsed.consumed:]
        assert len(rest) <= (0 if last else MAX_UNCONSUMED[name])
    return readings, counts, rest


@pytest.mark.parametrize('name', FRAMINGS)
@settings(derandomize=True, deadline=None, max_examples=120)
@given(seed=st.integers(0, 2**32), places=st.lists(st.integers(0, 2**16), max_size=12),
       final=st.booleans(), single=st.booleans())
def test_chunk_boundaries_do_not_change_the_result(name, seed, places, final, single):
    stream = random_stream(name, seed)
    if single:
        pieces = [stream[i:i + 1] for i in range(len(stream))] or [b'']
    else:
        cuts = sorted({p % (len(stream) + 1) for p in places})
        pieces = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    assert parse_pieces(name, pieces, final) == parse_pieces(name, [stream], final)


@pytest.mark.parametrize('name', FRAMINGS)
def test_every_lost_frame_is_counted(name):
    framing = FRAMINGS[name][0]
    n_found = n_rejected = 0
    for seed in range(300):
        stream = random_stream(name, seed)
        readings, counts, rest = parse_pieces(name, [stream], bool(seed % 2))
        n_found, n_rejected = n_found + len(readings), n_rejected + sum(counts.values())
        if isinstance(framing, BinaryFraming):
            n_sensors = 4 if name == 'binary of a board' else 1
            frames = len(readings) // n_sensors
            assert frames * framing.size + count_of(counts, 'between') + len(rest) == len(stream)
        else:
            end = b'\r\n\r' if name == 'lines with a long end' else b'\n'
            *lines, tail = stream.split(end)
            assert len(readings) + sum(counts.values()) == len(lines) + bool(seed % 2 and tail)
    assert n_found > 50 and n_rejected > 50


@pytest.mark.parametrize('name', CASES)
def test_every_frame_between_garbage_is_found_and_no_reading_is_false(name):
    result = fuzz(CASES[name], 20_000)
    # A 16-bit checksum accepts one false frame in 65536; with this seed it accepts none.
    assert result.lost == result.invented == 0
    assert result.found == result.readings >= result.sent == 20_000
    assert result.garbage > 200_000 and result.worst_rest <= MAX_UNCONSUMED[name]


def test_the_fuzzer_detects_lost_and_invented_readings():
    case = CASES['binary']

    class LossyFraming(BinaryFraming):
        def parse(self, data, final=False):
            parsed = super().parse(data, final)
            return parsed if len(data) % 5 else type(parsed)((), parsed.consumed)

    lossy = BinarySettings(sync='A5 5A', checksum='crc32', fields=(
        'sequence:u16', 'ticks:u32', 'x:f32', 'y:f32', 'z:f32'))
    assert fuzz(case._replace(make_framing=lambda: LossyFraming(lossy)), 500).lost > 0
    unchecked = BinarySettings(sync='A5 5A', fields=(*lossy.fields, '-:u32'))
    result = fuzz(case._replace(make_framing=lambda: BinaryFraming(unchecked)), 500)
    assert result.invented > 0 and result.lost > 0 and result.failed(0.0)
    assert not fuzz(case, 500).failed(0.0)


@pytest.mark.parametrize('name, piece, size', [
    ('text', b'9', 2**20), ('text', b'\n', 2**18), ('text', b'$MAG,', 2**20), ('json', b'{', 2**20),
    ('json', b'[\n', 2**16), ('binary', b'\xa5\x5a', 2**20), ('binary', b'\xa5', 2**20),
    ('binary of a board', b'\xff', 2**19)])
def test_a_megabyte_without_frames_takes_linear_time(name, piece, size):
    framing = FRAMINGS[name][0]
    stream = piece * (size // len(piece))
    start = time.process_time()
    parsed = framing.parse(stream)
    # Parsing takes about a second; in quadratic time it would take hours.
    assert time.process_time() - start < 20.0
    assert not parsed.readings and len(stream) - parsed.consumed <= MAX_UNCONSUMED[name]
    pieces = [stream[i:i + 1000] for i in range(0, 2**16, 1000)]
    assert parse_pieces(name, pieces, True) == parse_pieces(name, [b''.join(pieces)], True)


@pytest.mark.parametrize('value', [b'1' * 60_000 + b'x', b' ' * 60_000 + b'x', b'1.' + b'1' * 60_000
                                   + b'e', b'nan' * 20_000, b'+' * 60_000, b'.' * 60_000])
def test_a_long_invalid_value_takes_linear_time(value):
    framing = TextFraming(TextSettings(fields=('x',), max_length=65536))
    start = time.process_time()
    assert_counts(framing.parse(value, final=True).rejected, {'not a number': 1})
    assert time.process_time() - start < 1.0
