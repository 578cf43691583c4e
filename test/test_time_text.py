"""Dates, times of day and units as text; the oracle of dates is `datetime.strftime`."""

import datetime
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mag_tracking.errors import SettingsError
from mag_tracking.units import DAY_NS, date_order, field_scale, parse_time, time_scale

FORMS = ('%Y-%m-%dT%H:%M:%S.%f', '%Y/%m/%d %H:%M:%S.%f', '%Y%m%dT%H%M%S.%f', '%d.%m.%Y %H:%M:%S,%f',
         '%d/%m/%Y %I:%M:%S.%f %p', '%d %b %Y %H:%M:%S.%f', '%A, %d %B %Y %H:%M:%S.%f',
         '%B %d, %Y %I:%M:%S.%f %p', '%d-%b-%y %H:%M:%S.%f', '%Y-%m-%d_%H-%M-%S.%f',
         '%a %b %d %H:%M:%S.%f %Y', '%d/%b/%Y:%H:%M:%S.%f', '%Y %m %d %H %M %S.%f')
moments = st.datetimes(datetime.datetime(2000, 1, 1), datetime.datetime(2069, 12, 31))


@given(moments, st.sampled_from(FORMS), st.integers(-14 * 60, 14 * 60))
def test_a_date_is_read_in_every_form_and_zone(moment, form, minutes):
    expected = (moment - datetime.datetime(1970, 1, 1)) // datetime.timedelta(microseconds=1)
    assert parse_time(moment.strftime(form)) == (1000 * expected, True, False)
    if form.endswith('%Y') or '%p' in form:
        return
    zone = f'{"-" if minutes < 0 else "+"}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}'
    shifted = (1000 * (expected - minutes * 60 * 10**6), True, True)
    assert parse_time(moment.strftime(form) + zone) == shifted


@pytest.mark.parametrize('text, nanoseconds', [
    ('23:56:01.123456789', 86_161_123_456_789), ('11:56:01 pm', 86_161 * 10**9),
    ('12:00:01 AM', 10**9), ('1 day, 0:00:01.5', DAY_NS + 1_500_000_000), ('24:00:00', DAY_NS),
    ('56:01.25', 3_361_250_000_000), ('235601.25', 86_161_250_000_000)])
def test_a_time_of_day_or_a_duration_is_read(text, nanoseconds):
    assert parse_time(text) == (nanoseconds, False, False)


@pytest.mark.parametrize('text, fault', [
    ('2026-05-03 23:56:01 CET', 'CET'), ('2026-13-03 00:00:00', 'month'),
    ('25:00:00', 'of day'),
    ('13:00:00 pm', '13 PM'), ('03 Mai 2026', 'Mai'), ('noon', 'neither'), ('12.5', 'seconds'),
    ('', 'neither'), ('1:2:3' + ' ' * 50_000 + 'x', 'neither'), ('1:' * 50_000, 'too long')])
def test_an_invalid_time_is_refused_at_once(text, fault):
    begin = time.process_time()
    with pytest.raises(ValueError, match=fault):
        parse_time(text)
    assert time.process_time() - begin < 1.0


@pytest.mark.parametrize('texts, order', [
    (['03/05/2026 1:00'], None), (['03/05/2026', '13/05/2026'], 'dmy'),
    (['03/05/2026', '03/13/2026'], 'mdy'), (['03.05.26'], 'dmy'), (['26-05-12'], None),
    (['2026-05-03'], 'ymd'), (['13/14/2026'], None), (['03 May 2026'], 'ymd')])
def test_the_order_of_a_date_follows_from_all_dates(texts, order):
    assert date_order(texts) == order


@pytest.mark.parametrize('text, tesla', [
    ('uT', 1e-6), ('\u00b5T', 1e-6), ('\u03bcT', 1e-6), ('[nT]', 1e-9), ('Gauss', 1e-4),
    ('milligauss', 1e-7), ('1090/G', 1e-4 / 1090), ('1090 counts per gauss', 1e-4 / 1090),
    ('0.15 uT/LSB', 1.5e-7), ('-1.5e-8', -1.5e-8)])
def test_a_unit_of_the_field_has_many_spellings(text, tesla):
    assert field_scale(text) == pytest.approx(tesla, rel=1e-12)


@pytest.mark.parametrize('text', ['MT', '1090', '0', 'nan', '0/G', 'uT uT', '1/x'])
def test_an_unknown_unit_is_refused(text):
    with pytest.raises(SettingsError, match='unit: '):
        field_scale(text)


def test_a_unit_of_time_is_exact():
    assert 32768 * time_scale('32768/s') == time_scale('s') == 1000 * time_scale('millis')
    for text in ('0', '-1', 'x', '0/s', '1/0'):
        with pytest.raises(SettingsError, match='time unit'):
            time_scale(text)
