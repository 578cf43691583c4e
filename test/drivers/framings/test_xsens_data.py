"""Decoding of Xsens messages: recorded messages, number formats and layouts of MTData."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.drivers.framings.xsens import XsensFraming, XsensSettings
from mag_tracking.drivers.reading import Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import replace
from support.counters import assert_counts
from support.xsens_messages import (
    DOUBLE,
    FLOAT,
    FP1220,
    FP1632,
    FRAME,
    LAYOUT,
    READING,
    message,
    mtdata2,
    packet,
    random_reading,
    reals,
)

BETWEEN = 'bytes between frames'
INVALID_LENGTHS = 'MTData2 messages with invalid packet lengths'
NO_VALUES = 'messages without field or acceleration'
LEGACY = XsensFraming(XsensSettings(mtdata=LAYOUT))
FRAMING = XsensFraming(XsensSettings())


# Recorded messages.

MTI_G_710 = bytes.fromhex(
    'faff3662102002a9861060040314ed5310100c07440be007e301140d2f1837e0200401800007'
    '40200cbc8e5466c0e82f10bf9ad29e40100cb935269fbd949930bc46234680200cbb425c343b'
    '1068df3ae1c7e58030103f800001b778c7f03738d82737107feef7')
MTI_300 = bytes.fromhex(
    '102002a6551060040057472e2010103f7f7dc4bc10107d3ba15770bd7ec65640200cbda21af8'
    'be2a8e96411d27a240100cb94fc800b9da24003cc9288040300c3c02c89c3c35f6c83cdb0c00'
    '80200cbbb17d81bb9632003c01e8418030103f800000b6e33001b6c0400037264800c0200cbe'
    '999c243fb61b563f166aeb301004000186dee0200400400003')
CONFIGURATION = bytes.fromhex(
    'faff0d76037003f80480' + '00' * 90 + '0001037003f800000000000000010027010802490501' + '9b')


def test_a_recorded_message_of_an_mti_g_710_is_decoded():
    """The reference values come from another decoder."""
    parsed = FRAMING.parse(MTI_G_710)
    reading, = parsed.readings
    assert reading.field is None
    assert reading.acceleration == (-0.017374228686094284, -7.255744934082031, -1.209552526473999)
    assert (reading.sequence, reading.ticks) == (43398, 51703123.0)
    assert parsed.consumed == len(MTI_G_710) and parsed.rejected == {}


def test_the_clock_and_sequence_defaults_match_the_messages():
    """The next message of the recording arrived 10 ms later, with 51703223 ticks."""
    reading, = FRAMING.parse(MTI_G_710).readings
    assert (51703223 - reading.ticks) * FRAMING.CLOCK['tick_s'] == pytest.approx(0.01)
    last = READING._replace(ticks=float(0xFFFFFFFF), sequence=0xFFFF)
    assert FRAMING.parse(mtdata2(last)).readings == (last,)
    assert FRAMING.CLOCK['wrap'] == last.ticks + 1
    assert FRAMING.DRIVER['sequence_wrap'] == last.sequence + 1


def test_a_recorded_message_of_an_mti_300_is_decoded():
    """The reference values come from Xsens' MT Manager."""
    parsed = FRAMING.parse(message(0x36, MTI_300))
    reading, = parsed.readings
    assert reading.field == pytest.approx((-0.30001938, 1.42270923, 0.58756894), abs=5e-9)
    assert reading.acceleration == pytest.approx((-0.07915300, -0.16655955, 9.82217598), abs=5e-9)
    assert (reading.sensor, reading.sequence, reading.ticks) == ('', 42581, 5719854.0)
    assert parsed.rejected == {}


def test_recorded_replies_are_consumed_and_counted():
    replies = bytes.fromhex('faff3100d0') + CONFIGURATION + bytes.fromhex('faff0304037003f88c')
    parsed = FRAMING.parse(replies + FRAME)
    assert parsed.readings == (READING,) and parsed.consumed == len(replies + FRAME)
    assert parsed.rejected == {
        'other messages: 0x31': 1, 'other messages: 0x0D': 1, 'other messages: 0x03': 1}


# Contents of a message.

@pytest.mark.parametrize('precision, coded, values', [
    (FLOAT, '3f800000 c0200000 00000000', (1.0, -2.5, 0.0)),
    (FP1220, '00100000 ffd80000 00000001', (1.0, -2.5, 2.0**-20)),
    (FP1632, '000000000001 80000000fffd 00000001ffff', (1.0, -2.5, -1.0 + 2.0**-32)),
    (DOUBLE, '3ff0000000000000 c004000000000000 0000000000000000', (1.0, -2.5, 0.0))])
@pytest.mark.parametrize('coordinates', [0x0, 0x4, 0x8])
def test_the_four_number_formats_are_decoded(precision, coded, values, coordinates):
    data = bytes.fromhex(coded)
    for kind, name in ((0xC020, 'field'), (0x4020, 'acceleration')):
        parsed = FRAMING.parse(message(0x36, packet(kind + coordinates + precision, data)))
        assert parsed.readings == (Reading(**{name: values}),)
        assert parsed.rejected == {}


@settings(derandomize=True, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([FLOAT, FP1220, FP1632, DOUBLE]), st.booleans())
def test_encoded_readings_are_decoded(seed, precision, extended):
    rng = random.Random(seed)
    reading = random_reading(rng, precision)
    data = mtdata2(reading, precision)
    body = data[4:-1]
    parsed = FRAMING.parse(message(0x36, body, extended))
    assert parsed.readings == (reading,) and parsed.rejected == {}


def test_packets_may_have_any_order_and_unknown_packets_are_skipped():
    data = (packet(0xC020, reals(READING.field, FLOAT)) + packet(0x5A5F, b'\xfa\xff\x36')
            + packet(0x1070, b'\x00\x00\x00\x07') + packet(0x1020, b'\xa6\x55')
            + packet(0x2030, b'') + packet(0x1021, b'\x01\x02')
            + packet(0x1061, b'\x01\x02\x03\x04') + packet(0xC810, b'') + packet(0xA210, b''))
    parsed = FRAMING.parse(message(0x36, data), final=True)
    assert parsed.readings == (Reading(field=READING.field, sequence=42581),)
    assert parsed.rejected == {}


def test_unused_and_duplicate_packets_are_counted():
    packets = (packet(0xA010, bytes(20)) + packet(0xC010, bytes(6)) + packet(0xC034, bytes(12))
               + packet(0xC020, bytes(12)) + packet(0x1020, bytes(2)))
    parsed = FRAMING.parse(mtdata2(READING, behind=packets))
    assert parsed.readings == (READING,)
    assert_counts(parsed.rejected, {
        'not used: 0xA010': 1, 'not used: 0xC010': 1, 'not used: 0xC034': 1,
        'message: 0xC020': 1, 'message: 0x1020': 1})


@pytest.mark.parametrize('data', [b'', packet(0x2010, bytes(16)), packet(0x1020, b'\x00\x01')])
def test_a_message_without_field_or_acceleration_is_counted(data):
    parsed = FRAMING.parse(message(0x36, data) + FRAME)
    assert parsed.readings == (READING,) and parsed.rejected == {NO_VALUES: 1}


@pytest.mark.parametrize('data', [
    b'\x10', b'\x10\x20', packet(0xC020, bytes(12)) + b'\x10\x20', packet(0xC020, bytes(12))[:-1],
    b'\x50\x10\x01', packet(0xC020, bytes(11)), packet(0xC020, bytes(13)),
    packet(0xC021, bytes(18)), packet(0xC022, bytes(24)), packet(0xC023, bytes(12)),
    packet(0x4020, bytes(8)), packet(0x1020, bytes(4)), packet(0x1060, bytes(2)),
    packet(0x1020, b''), packet(0xC020, bytes(12)) + packet(0x1060, bytes(8))])
def test_packets_of_invalid_length_reject_the_message(data):
    false = message(0x36, data)
    parsed = FRAMING.parse(false + FRAME)
    assert parsed.readings == (READING,)
    assert parsed.rejected == {INVALID_LENGTHS: 1, BETWEEN: len(false)}


def test_a_nan_in_the_field_is_returned_unchanged():
    parsed = FRAMING.parse(mtdata2(Reading(field=(1.0, float('nan'), 2.0))))
    assert str(parsed.readings[0].field) == '(1.0, nan, 2.0)'


# MTData.

@pytest.mark.parametrize('blocks', [
    ('mag',), ('acc',), ('acc', 'gyr', 'mag'),
    ('temp', 'acc', 'gyr', 'mag', 'quaternion', 'counter'),
    ('acc', 'gyr', 'mag', 'euler', 'analog_1', 'analog_2', 'status'),
    ('temp', 'gyr', 'mag', 'matrix', 'analog_2', 'status', 'counter')])
@pytest.mark.parametrize('number_format, precision', [('float', FLOAT), ('fp12.20', FP1220)])
def test_mtdata_is_decoded_with_the_layout_of_the_settings(blocks, number_format, precision):
    encoded = {'temp': reals([21.5], precision), 'acc': reals(READING.acceleration, precision),
               'gyr': reals((0.1, 0.2, 0.3), precision), 'mag': reals(READING.field, precision),
               'quaternion': reals((1.0, 0.5, 0.25, 0.0), precision),
               'euler': reals((-1.0, 2.0, -3.0), precision), 'matrix': reals([0.5] * 9, precision),
               'analog_1': b'\x01\x02', 'analog_2': b'\x03\x04', 'status': b'\x07',
               'counter': b'\xa6\x55'}
    framing = XsensFraming(replace(XsensSettings(), {
        'mtdata': list(blocks), 'mtdata_format': number_format}))
    parsed = framing.parse(message(0x32, b''.join(encoded[block] for block in blocks)))
    assert parsed.rejected == {}
    assert parsed.readings == (Reading(
        field=READING.field if 'mag' in blocks else None,
        acceleration=READING.acceleration if 'acc' in blocks else None,
        sequence=42581 if 'counter' in blocks else None),)


def test_mtdata_that_does_not_match_the_settings_is_counted():
    sent = message(0x32, bytes(41)) + message(0x32, bytes(43)) + message(0x32, b'') + FRAME
    parsed = LEGACY.parse(sent)
    assert parsed.readings == (READING,)
    assert_counts(parsed.rejected, {'length': 3})
    parsed = FRAMING.parse(sent)
    assert parsed.readings == (READING,)
    assert_counts(parsed.rejected, {'none': 3})


@pytest.mark.parametrize('changes, text', [
    ({'mtdata': ['acc', 'mga']}, "unknown block 'mga'; known: temp, acc, gyr, mag"),
    ({'mtdata': ['none', 'mag']}, "unknown block 'none'"),
    ({'mtdata': ['mag', 'acc']}, 'got mag, acc'),
    ({'mtdata': ['mag', 'mag']}, 'got mag, mag'),
    ({'mtdata': ['mag', 'quaternion', 'euler']}, 'euler, matrix, quaternion'),
    ({'mtdata': ['temp', 'gyr', 'counter']}, 'got temp, gyr, counter'),
    ({'mtdata': ['mag'], 'mtdata_format': 'double'},
     "mtdata_format: .*'double'"),
    ({'mtdata_format': 'fp12.20'}, "mtdata_format is 'fp12.20'"),
    ({'max_message': 253}, 'max_message: 253 is outside'),
    ({'max_message': 4097}, 'max_message: 4097 is outside')])
def test_invalid_settings_are_refused(changes, text):
    with pytest.raises(SettingsError, match=text):
        XsensFraming(replace(XsensFraming.SETTINGS(), changes))
