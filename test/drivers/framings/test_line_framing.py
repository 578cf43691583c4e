"""Framing of lines of text and of JSON objects."""

import math

import pytest

from mag_tracking.drivers.framings.json_objects import JsonFraming, JsonSettings
from mag_tracking.drivers.framings.text import TextFraming, TextSettings
from mag_tracking.drivers.reading import DeviceDate, Reading
from mag_tracking.errors import SettingsError
from mag_tracking.settings import replace
from support.counters import assert_counts

XYZ = ('x', 'y', 'z')
READING = Reading('', (1.0, 2.0, 3.0))


def text_framing(**changes):
    return TextFraming(replace(TextSettings(), {'fields': XYZ, **changes}))


def json_framing(**changes):
    return JsonFraming(replace(JsonSettings(), {'field': ['m'], **changes}))


# Text.

ALL_FIELDS = ('sensor', 'ticks', 'sequence', '-', 'x', 'y', 'z')


@pytest.mark.parametrize('line, expected', [
    (b'A,1.5,7,?,1,2,3', Reading('A', (1.0, 2.0, 3.0), None, 1.5, 7)),
    (b'A b\t, 2 ,\t+7,, -1.e1 ,.5,+2.5E-1 \r', Reading('A b', (-10.0, 0.5, 0.25), None, 2.0, 7)),
    ('ß,1,-7,１,,nan,-NaN'.encode(), Reading('ß', (math.nan,) * 3, None, 1.0, -7)),
    (b'a,1,18446744073709551615,,1,2,' + b'0' * 400, Reading(
        'a', (1.0, 2.0, 0.0), None, 1.0, 2**64 - 1))])
def test_a_line_of_text_is_parsed(line, expected):
    for data, final in ((line + b'\n', False), (line, True)):
        parsed = text_framing(fields=ALL_FIELDS).parse(data, final)
        assert repr(parsed.readings) == repr((expected,))
        assert parsed.consumed == len(data) and not parsed.rejected


@pytest.mark.parametrize('line, cause', [
    (b'1,2', 'number of fields'),
    (b'1,2,3,', 'number of fields'),
    (b'1_0,2,3', 'not a number'),
    ('１,2,3'.encode(), 'not a number'),
    (b'0x1,2,3', 'not a number'),
    (b'1e,2,3', 'not a number'),
    (b'.,2,3', 'not a number'),
    (b'1 2,2,3', 'not a number'),
    (b'1,2,3\r\r', 'not a number'),
    (b'1,2,\xa03', 'UTF-8'),
    (b'1,2,inf', 'infinite'),
    (b'1,2,-Infinity', 'infinite'),
    (b'1,2,1e999', 'infinite'),
    (b'1,2,' + b'9' * 400, 'infinite'),
    (b'1,2,' + b'0' * 509, 'max_length'),
    (b'', 'empty'),
    (b' \t\r', 'empty')])
def test_an_invalid_line_is_rejected_with_its_cause(line, cause):
    parsed = text_framing().parse(line + b'\n1,2,3\n')
    assert_counts(parsed.rejected, {cause: 1})
    assert parsed.readings == (READING,)


@pytest.mark.parametrize('line, cause', [
    (b',1,7,?,1,2,3', 'sensor name'),
    (b'a' * 65 + b',1,7,?,1,2,3', 'sensor name'),
    (b'a\x07,1,7,?,1,2,3', 'sensor name'),
    (b'A,,7,?,1,2,3', 'without ticks'),
    (b'A,nan,7,?,1,2,3', 'without ticks'),
    (b'A,inf,7,?,1,2,3', 'infinite'),
    (b'A,1,,?,1,2,3', 'integer'),
    (b'A,1,7.0,?,1,2,3', 'integer'),
    (b'A,1,1_0,?,1,2,3', 'integer'),
    (b'A,1,' + b'1' * 5000 + b',?,1,2,3', 'integer'),
    (b'A,1,18446744073709551616,?,1,2,3', '64 bits'),
    (b'A,1,-9223372036854775809,?,1,2,3', '64 bits')])
def test_a_missing_or_invalid_value_rejects_the_line(line, cause):
    parsed = text_framing(fields=ALL_FIELDS, max_length=6000).parse(line, final=True)
    assert_counts(parsed.rejected, {cause: 1})
    assert not parsed.readings


def test_separators_ends_prefixes_and_comments_are_configurable():
    assert text_framing(separator=' ').parse(b' 1 \t2   3\n').readings == (READING,)
    assert text_framing(separator='; ').parse(b'1; 2; 3\n').readings == (READING,)
    assert text_framing(separator='\\t').parse(b'1\t2\t3\n').readings == (READING,)
    assert text_framing(end=';').parse(b'1,2,3\r;').readings == (READING,)
    assert text_framing(end='\r\n').parse(b'1,2,3\r\n1,2').consumed == 7
    parsed = text_framing(prefix='$MAG,', comment='#').parse(
        b'$MAG,1,2,3\n# $MAG,1,2,3\n1,2,3\n $MAG,1,2,3\n')
    assert parsed.readings == (READING,)
    assert_counts(parsed.rejected, {'prefix': 2, 'comments': 1})
    assert_counts(text_framing().parse(b'#1,2,3\n').rejected, {'not a number': 1})


@pytest.mark.parametrize('line, cause', [
    (b'$GPGLL,5300.97914,N,00259.98174,E,125926,A*28', None),
    (b'GPGLL,5300.97914,N,00259.98174,E,125926,A*28\r', None),
    (b'$MAG,1,-,2,-,5.5,*66', None), (b'$MAG,1,-,2,-,3e1,*2F', None),
    (b'$MAG,1,-,2,-,3e1,*2f', None),
    (b'$MAG,1,-,2,-,5.5,*67', 'wrong'),
    (b'$MAG,1,-,2,-,5.5,* 6', 'wrong'),
    (b'$MAG,1,-,2,-,5.5,*6', 'without'),
    (b'$MAG,1,-,2,-,5.5,*066', 'without'),
    (b'$MAG,1,-,2,-,5.5,', 'without')])
def test_nmea_checksums_are_checked(line, cause):
    framing = text_framing(fields=('-', 'x', '-', 'y', '-', 'z', '-'), checksum='nmea')
    parsed = framing.parse(line + b'\n')
    assert_counts(parsed.rejected, {cause: 1} if cause else {})
    assert len(parsed.readings) == (cause is None)


@pytest.mark.parametrize('changes, message', [
    ({'end': ''}, 'end'), ({'separator': ''}, 'separator'), ({'separator': '.'}, 'separator'),
    ({'separator': 'e'}, 'separator'), ({'separator': '\\n'}, 'separator'),
    ({'prefix': 'a\n'}, 'prefix: '),
    ({'comment': '\\n'}, 'comment: '),
    ({'prefix': '$M', 'comment': '$'}, 'ignored'),
    ({'checksum': 'crc8'}, "checksum: .*'crc8'"),
    ({'max_length': 0}, 'max_length'), ({'fields': ['B']}, "fields: 'B': ")])
def test_invalid_text_settings_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        text_framing(**changes)


# JSON.

PATHS = {'sensor': 'id', 'ticks': 'clock.t', 'sequence': 'n', 'field': ['m.x', '', 'm.y.1'],
         'acceleration': ['a']}


def test_an_object_with_every_quantity_is_parsed():
    line = (b'{"id": "A", "clock": {"t": 1e3}, "n": 7, "m": {"x": 1, "y": [0, 2.5]}, '
            b'"a": [null, NaN, -3], "else": {"huge": Infinity}}\r\n')
    expected = Reading('A', (1.0, math.nan, 2.5), (math.nan, math.nan, -3.0), 1000.0, 7)
    for data in (line, line.replace(b'"A"', b'"\\u0041"'), line.replace(b'7', b'7.0')):
        parsed = json_framing(**PATHS).parse(data)
        assert repr(parsed.readings) == repr((expected,)) and not parsed.rejected
    assert [type(v) for v in parsed.readings[0].field] == [float] * 3
    assert isinstance(parsed.readings[0].sequence, int)
    assert json_framing(**PATHS).parse(line.replace(b'"A"', b'12')).readings[0].sensor == '12'


@pytest.mark.parametrize('line, cause', [
    (b'{"m": [1, 2]}', 'm is'),
    (b'{"m": [1, 2, 3, 4]}', 'm is'),
    (b'{"m": {"0": 1, "1": 2, "2": 3}}', 'm is'),
    (b'{"m": null}', 'm is'),
    (b'{"x": [1, 2, 3]}', 'without m'),
    (b'{"m": [1, 2, true]}', 'm.2'),
    (b'{"m": [1, 2, "3 nT"]}', 'm.2'),
    (b'{"m": [1, 2, Infinity]}', 'infinite'),
    (b'{"m": [1, 2, 1e999]}', 'infinite'),
    (b'{"m": [1, 2, 1' + b'0' * 400 + b']}', 'infinite'),
    (b'{"m": [1, 2, 1' + b'0' * 5000 + b']}', 'not JSON'),
    (b'{"m": [1, 2, 3], "m": [1, 2, 3]}', 'duplicate'),
    (b'{"m": [1, 2, 3], "d": [{"a": 0, "a": 0}]}', 'duplicate'),
    (b'{"m": [1, 2, 3], "d": ' + b'[' * 60_000 + b']' * 60_000 + b'}',
     'deeply'),
    (b'{"m":' * 30_000, 'deeply'),
    (b'{"m": [1, 2, 3]', 'not JSON'),
    (b'{"m": [1, 2, 3]} {}', 'not JSON'),
    (b'{"m": [1, 2, 3,]}', 'not JSON'),
    (b'\xef\xbb\xbf{"m": [1, 2, 3]}', 'not JSON'),
    (b'[1, 2, 3]', 'JSON object'),
    (b'"m"', 'JSON object'),
    (b'{"m": [1, 2, 3], "\xff": 1}', 'UTF-8'),
    ('{"m": [1, 2, 3]}'.encode('utf-16'), 'UTF-8'),
    (b' ', 'empty'),
    (b'{"m": [1, 2, 3]' + b' ' * 200_000 + b'}', 'max_length')])
def test_an_invalid_object_is_rejected_with_its_cause(line, cause):
    framing = json_framing(max_length=200_000)
    parsed = framing.parse(line + b'\n{"m":[1,2,3]}\n')
    assert_counts(parsed.rejected, {cause: 1})
    assert parsed.readings == (READING,)
    assert_counts(framing.parse(line, final=True).rejected, {cause: 1})


@pytest.mark.parametrize('old, new, cause', [
    (b'"A"', b'true', 'id is'), (b'"A"', b'1.5', 'id is'),
    (b'"A"', b'null', 'id is'), (b'"A"', b'""', 'sensor name'),
    (b'"A"', b'"\\ud800"', 'sensor name'),
    (b'"A"', b'9' * 4000, 'sensor name'),
    (b'"t": 5', b'"t": null', 'clock.t'),
    (b'"t": 5', b'"t": NaN', 'without ticks'), (b'"t": 5', b'"u": 5', 'without clock.t'),
    (b'"n": 7', b'"n": 7.5', 'integer'),
    (b'"n": 7', b'"n": NaN', 'integer'),
    (b'"n": 7', b'"n": -Infinity', 'integer'),
    (b'"n": 7', b'"n": 1e30', '64 bits'),
    (b'"n": 7', b'"n": false', 'not a number'),
    (b'[1, 2]', b'[1]', 'without m.y.1'), (b'[1, 2]', b'{"0": 1}', 'without m.y.1'),
    (b'{"x"', b'{"q"', 'without m.x'), (b'{"x": 1, "y": [1, 2]}', b'"xy"', 'without m.x'),
    (b'{"x": 1, "y": [1, 2]}', b'[1]', 'without m.x')])
def test_a_path_without_a_valid_value_rejects_the_object(old, new, cause):
    line = (b'{"id": "A", "clock": {"t": 5}, "n": 7, "m": {"x": 1, "y": [1, 2]}, '
            b'"a": [1, 2, 3]}\n')
    framing = json_framing(**PATHS, max_length=5000)
    assert len(framing.parse(line).readings) == 1 and line.count(old) == 1
    parsed = framing.parse(line.replace(old, new))
    assert_counts(parsed.rejected, {cause: 1})
    assert not parsed.readings


def test_an_object_of_several_lines_must_be_a_message_of_its_own():
    pretty = b'{\n "m": [1,\n 2, 3]\n}\n'
    assert_counts(json_framing().parse(pretty).rejected, {'not JSON': 4})
    parsed = json_framing().parse(pretty, final=True)
    assert parsed.readings == (READING,) and parsed.consumed == len(pretty) and not parsed.rejected
    short = json_framing(max_length=len(pretty) - 1)
    assert_counts(short.parse(pretty, final=True).rejected, {'not JSON': 4})
    # Several objects in a message are read as lines, even if one of them is invalid.
    for bad in (b'{"m": 1, "m": 1}', b'\xff', b'['):
        parsed = json_framing().parse(bad + b'\n{"m":[1,2,3]}\n{"m":[1,2,3]}', final=True)
        assert parsed.readings == (READING, READING) and sum(parsed.rejected.values()) == 1
    assert_counts(json_framing().parse(b'[1,\n2]', final=True).rejected, {'JSON object': 1})


@pytest.mark.parametrize('changes, message', [
    ({'field': ['a', 'b']}, 'field: .*three axes'),
    ({'field': ['']}, 'field: a path'),
    ({'field': [''], 'ticks': 't'}, 'field: a path'),
    ({'field': ['', '', '']}, 'field: a path'),
    ({'acceleration': ['a', 'b', 'c', 'd']}, 'acceleration: expected'),
    ({'ticks': 'a..b'}, "ticks: 'a..b' "), ({'field': ['.a']}, 'empty key'),
    ({'end': ''}, 'end')])
def test_invalid_json_settings_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        json_framing(**changes)


# Values as loggers write them.

@pytest.mark.parametrize('line, expected', [
    (b'{"m":["1.0", " 2 ", "3e0"]}', (1.0, 2.0, 3.0)),
    (b'{ t:"7", m:[1, 2, 3] }', (1.0, 2.0, 3.0)),
    (b"{'m': [1.0, nan, 3], 'name': 'a \\\\ b', 'on': True, 'off': None}", (1.0, math.nan, 3.0)),
    (b'{m: [1, 2, 3], "text": "it\'s k: 5, \\"x: 1"}', (1.0, 2.0, 3.0)),
    (b'{"m":[1, null, ""]}', (1.0, math.nan, math.nan))])
def test_objects_of_javascript_and_python_are_read(line, expected):
    parsed = json_framing().parse(line + b'\n')
    assert repr(parsed.readings) == repr((Reading('', expected),)) and not parsed.rejected


@pytest.mark.parametrize('text, microseconds', [
    ('03 May 2026 23:56:01.25', 1_777_852_561_250_000), ('2026-05-03T23:56:01Z', 1_777_852_561e6),
    ('2026-05-04T01:56:01.000001+02:00', 1_777_852_561_000_001), ('00:00:01.5', 1_500_000)])
def test_a_device_time_may_be_a_date(text, microseconds):
    for framing, line in ((json_framing(ticks='t'), f'{{"t": "{text}", "m": [1, 2, 3]}}'),
                          (text_framing(fields=('ticks', *XYZ)), f'"{text}",1,2,3')):
        (reading,) = framing.parse(line.encode() + b'\n').readings
        assert reading == READING._replace(ticks=microseconds)
        assert isinstance(reading.ticks, DeviceDate)


def test_date_and_time_of_day_may_be_two_values():
    framing = text_framing(fields=('date', 'ticks', *XYZ), separator=' ')
    (reading,) = framing.parse(b'2026-05-03  23:56:01.25 1 2 3\n').readings
    assert reading == READING._replace(ticks=1_777_852_561_250_000)
    assert framing.parse(b'2026-05-03 noon 1 2 3\n').rejected
    with pytest.raises(SettingsError, match='date'):
        text_framing(fields=('date', *XYZ))


def test_decimal_commas_are_read_as_stated():
    line = b'1,5;2,0;-3,25e1\n'
    parsed = text_framing(separator=';', decimal=',').parse(line)
    assert parsed.readings == (Reading('', (1.5, 2.0, -32.5)),)
    line = b'{"t": "7,5", "m": ["1,5", "2", 3.0]}\n'
    parsed = json_framing(ticks='t', decimal=',').parse(line)
    assert parsed.readings == (Reading('', (1.5, 2.0, 3.0), None, 7.5),)
    with pytest.raises(SettingsError, match='separator'):
        text_framing(decimal=',')


@pytest.mark.parametrize('framing, line, remedy', [
    (text_framing(separator=';'), '1,5;2;3', "decimal: ','"),
    (text_framing(), '1;2;3', "separator: ';'"), (text_framing(), '1 2 3', "separator: ' '"),
    (text_framing(), '7,1,2,3', 'it has 4 values'), (text_framing(), '1uT,2uT,3uT', "'1uT'"),
    (text_framing(fields=('ticks', *XYZ)), 'noon,1,2,3', 'ISO 8601'),
    (json_framing(), '{"mag": {"x": 1, "y": 2}}', "'mag.x', 'mag.y'"),
    (json_framing(), '1,2,3', 'framing text'), (json_framing(), '[1, 2, 3]', '{"x":'),
    (json_framing(), '{"m": ["1,5", 2, 3]}', "decimal: ','"),
    (json_framing(), '{"m": [' + '{"a": ' * 400 + '1' + '}' * 400 + ', 2, 3]}', 'type dict')])
def test_a_rejected_line_is_shown_with_a_remedy(framing, line, remedy):
    parsed = framing.parse(line.encode() + b'\n' + line.encode() + b'\n')
    ((cause, n),) = parsed.rejected.items()
    assert n == 2 and set(parsed.examples) == {cause}
    assert repr(line[:20])[1:-1] in parsed.examples[cause] and remedy in parsed.examples[cause]
    assert len(parsed.examples[cause]) < 600
