"""Units, dates and times as text in tables, drivers files and device lines.

Internal quantities are in SI units, timestamps in integer nanoseconds.
"""

import datetime
import math
import re
import unicodedata
from collections.abc import Iterable
from fractions import Fraction
from functools import lru_cache

from mag_tracking.errors import SettingsError

NS = 1_000_000_000
"""Nanoseconds per second."""
NEVER = -2**63
"""Timestamp of an event that has not happened: the smallest int64 [ns]."""
LATEST_NS = 2**31 * NS
"""Upper bound of the timestamps in ROS headers [ns]. Differences of timestamps between -LATEST_NS
and LATEST_NS fit into int64, and no such timestamp equals `NEVER`."""
FIELD_UNITS = {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7}
"""Tesla per unit."""
TIME_UNITS = {'s': NS, 'ms': 10**6, 'us': 10**3, 'ns': 1, 'min': 60 * NS, 'h': 3600 * NS,
              'd': 86400 * NS}
"""Nanoseconds per unit."""
MAX_SCALE = 100.0
"""[T per count] A larger number is meant as counts per unit."""
_FIELD_NAMES = {
    'T': 't tesla teslas', 'mT': 'mt millitesla', 'uT': 'ut mut microtesla',
    'nT': 'nt nanotesla gamma gammas \u03b3',
    'G': 'g ga gs gauss', 'mG': 'mg mga mgs mgauss milligauss'}
_TIME_NAMES = {
    's': 's sec secs second seconds', 'ms': 'ms msec msecs milli millis millisecond milliseconds',
    'us': 'us mus usec usecs micros microsecond microseconds',
    'ns': 'ns nsec nsecs nanos nanosec nanosecond nanoseconds', 'min': 'min minute minutes',
    'h': 'h hour hours', 'd': 'd day days'}
_FIELD_OF, _TIME_OF = ({name: unit for unit, names in table.items() for name in names.split()}
                       for table in (_FIELD_NAMES, _TIME_NAMES))
_NUMBER = r'([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)'
_COUNT = r'(?:counts?|lsb|digits?|ticks?)'
_PER_UNIT = re.compile(rf'{_NUMBER}\s*{_COUNT}?\s*(?:/|\bper\b)\s*(\S+)', re.IGNORECASE).fullmatch
_PER_COUNT = re.compile(rf'([+-]?){_NUMBER}\s*([^\s/0-9.]+)(?:\s*(?:/|\bper\b)\s*{_COUNT})?',
                        re.IGNORECASE).fullmatch


def field_unit(text: str) -> str | None:
    """Key of `FIELD_UNITS` that a text names in any usual spelling ('µT', '[nT]', 'Gauss')."""
    name = _plain_name(text)
    # 'MT' is not millitesla, and 'MG' is not milligauss.
    return None if name[:1] == 'M' and len(name) == 2 else _FIELD_OF.get(name.lower())


def time_unit(text: str) -> str | None:
    """Key of `TIME_UNITS` that a text names in any usual spelling ('ms', 'millis', 'µs')."""
    return _TIME_OF.get(_plain_name(text).lower())


def unit_since_1970(value: float) -> str | None:
    """Unit ('s', 'ms', 'us' or 'ns') in which a number is a time of this century since 1970."""
    return next((unit for unit in ('s', 'ms', 'us', 'ns')
                 if 9e8 <= value * TIME_UNITS[unit] / NS <= LATEST_NS / NS), None)


def _plain_name(text: str) -> str:
    """Remove brackets and white space from the name of a unit, and write the micro sign as u."""
    # The first replacement repairs UTF-8 that was decoded as Latin-1.
    text = unicodedata.normalize('NFKC', text.replace('\u00c2\u00b5', '\u00b5'))
    return re.sub(r'[\s()\[\]<>{}_-]', '', text).replace('\u03bc', 'u')


def field_scale(text: str, name: str = 'unit') -> float:
    """Convert the unit of a field to tesla; `name` is the setting in the error message.

    The text is a unit such as 'uT', counts per unit such as '1090/G', unit per count such as '0.15
    uT', or tesla per count such as '1.5e-8'. Raises SettingsError if it is neither a unit nor a
    number other than 0, or exceeds `MAX_SCALE`.
    """
    text = text.strip()
    if unit := field_unit(text):
        return FIELD_UNITS[unit]
    scale = math.nan
    if (match := _PER_UNIT(text)) and (unit := field_unit(match[2])) and float(match[1]):
        scale = FIELD_UNITS[unit] / float(match[1])
    elif (match := _PER_COUNT(text)) and (unit := field_unit(match[3])):
        scale = float(match[1] + match[2]) * FIELD_UNITS[unit]
    else:
        try:
            scale = float(text)
        except ValueError:
            pass
    if not math.isfinite(scale) or scale == 0.0:
        raise SettingsError(f'{name}: {text!r} is neither one of {", ".join(FIELD_UNITS)}, nor a '
                            'number of counts per unit such as 1090/G, nor a number other than 0 '
                            '(tesla per count)')
    if abs(scale) > MAX_SCALE:
        raise SettingsError(f'{name}: {text} means {scale:g} tesla per count; for {text} counts '
                            f'per gauss, write {text}/G')
    return scale


def time_scale(text: str, name: str = 'time unit') -> Fraction:
    """Convert a unit of time to nanoseconds; `name` is the setting in the error message.

    The text is a unit such as 'ms', ticks per unit such as '32768/s', or seconds per tick such as
    '1e-4'. Raises SettingsError if it is neither a unit nor a positive number.
    """
    text = text.strip()
    if unit := time_unit(text):
        return Fraction(TIME_UNITS[unit])
    try:
        if (match := _PER_UNIT(text)) and (unit := time_unit(match[2])):
            return TIME_UNITS[unit] / Fraction(match[1])
        scale = Fraction(text) * NS
    except (ValueError, ZeroDivisionError):
        scale = Fraction(0)
    if scale <= 0:
        raise SettingsError(f'{name}: expected one of {", ".join(TIME_UNITS)}, ticks per unit such '
                            f'as 32768/s, or seconds per tick, got {text!r}')
    return scale


DATE_ORDERS = ('dmy', 'mdy', 'ymd')
"""Orders of day, month and year in a date of three numbers."""
FORMS = ('2026-05-03T23:56:01.250Z (ISO 8601), 2026-05-03 23:56:01.250, 03.05.2026 23:56:01.250, '
         '05/03/2026 11:56:01.250 PM, 03 May 2026 23:56:01.250 and 23:56:01.250')
"""Examples of the accepted forms, for messages."""
MAX_LENGTH = 80
"""Maximum length of a time."""
DAY_NS = 86400 * NS
_MONTHS = {name: k + 1 for k, name in enumerate(
    'jan feb mar apr may jun jul aug sep oct nov dec'.split())}
_SEPARATED = r'([0-9]{1,4})([-/. ])\s?([0-9]{1,2})\2\s?([0-9]{1,4})'
_DATE = re.compile(rf'''(?:[a-z]{{3,9}},?\s+(?=[0-9a-z]))??(?:
    {_SEPARATED} | (?P<compact>[0-9]{{8}})
    | (?P<day>[0-9]{{1,2}})[-/. ]?\s?(?P<month>(?!days?\b)[a-z]{{3,9}})\.?[-/., ]\s?
      (?P<year>[0-9]{{2,4}})
    | (?P<month2>[a-z]{{3,9}})\.?\s+(?P<day2>[0-9]{{1,2}}),?\s+(?P<year2>[0-9]{{4}})
    | (?P<year3>[0-9]{{4}})[-/. ]?(?P<month3>[a-z]{{3,9}})[-/. ]?(?P<day3>[0-9]{{1,2}})
    )(?:[T_,;\s]+|:(?=[0-9]{{2}}:)|$)''', re.IGNORECASE | re.VERBOSE).match
_CTIME = re.compile(r'(?:[a-z]{3},?\s+)?([a-z]{3})\s+([0-9]{1,2})\s+([0-9:.]+)\s+([0-9]{4})',
                    re.IGNORECASE).fullmatch
_TIME = re.compile(r'''(?:(?P<days>[0-9]+)\s*days?,?\s+)?
    (?:([0-9]{1,2})(?:([:.\-h\s])([0-9]{1,2})(?:(?:\3|m)([0-9]{1,2})(?:[.,:]([0-9]+))?s?)?
                     |([0-9]{2})([0-9]{2})(?:[.,]([0-9]+))?)
      |(?P<minutes>[0-9]{1,3}):(?P<seconds>[0-9]{1,2})[.,](?P<decimals>[0-9]+))
    \s*(?P<half>[ap]\.?\s?m\.?)?\s*(?P<zone>Z|UTC|GMT)?\s*(?P<shift>[+-][0-9]{2}(?::?[0-9]{2})?)?
    \s*(?:UTC|GMT)?''', re.IGNORECASE | re.VERBOSE).fullmatch


def parse_time(text: str, order: str = 'dmy') -> tuple[int, bool, bool]:
    """Convert a date and time to ns since 1970, or a time of day to ns since midnight.

    Return also whether there is a date, and whether there is a zone: Z, UTC, GMT or an offset.
    Without it, the zone is UTC. `order`, a value of `DATE_ORDERS`, applies to a date of three
    numbers whose year is not the first. A time of day may follow a number of days ('1 day,
    00:00:01'). Two numbers with decimals ('56:01.25') are minutes and seconds. Raises ValueError
    that says why a text is invalid.
    """
    # Matching takes long if white space is long, and a time is short.
    text = ' '.join(text.split())
    if len(text) > MAX_LENGTH:
        raise ValueError('it is too long for a time')
    if match := _CTIME(text):
        text = f'{match[2]} {match[1]} {match[4]} {match[3]}'
    day, rest = 0, text
    date = _DATE(text)
    if date:
        day, rest = _day(date, order), text[date.end():].strip()
    time = _TIME(rest) if rest else None
    if time is None and (rest or not date):
        named = re.fullmatch(r'.*[0-9]\s*([A-Za-z]{2,5})', rest)
        raise ValueError(f'{named[1]} is not an offset from UTC such as +02:00'
                         if named and _TIME(rest.removesuffix(named[1])) else
                         'it is neither a number nor a date and time')
    if time is None:
        return day * DAY_NS, True, False
    time_ns, has_zone = _time_of_day(time)
    return day * DAY_NS + time_ns, date is not None, has_zone


def _day(match: re.Match[str], order: str) -> int:
    """Number of days since 1970 of a date; raises ValueError if there is no such day."""
    named = match['month'] or match['month2'] or match['month3']
    if match['compact']:
        text = match['compact']
        return _ordinal(int(text[:4]), int(text[4:6]), int(text[6:]))
    if named:
        month = _MONTHS.get(named[:3].lower())
        if month is None:
            raise ValueError(f'{named} is not the English name of a month')
        return _ordinal(int(match['year'] or match['year2'] or match['year3']), month,
                        int(match['day'] or match['day2'] or match['day3']))
    first, _, second, third = match.group(1, 2, 3, 4)
    if len(first) > 2:
        order = 'ymd'
    numbers = dict(zip(order, (int(first), int(second), int(third)), strict=True))
    return _ordinal(numbers['y'], numbers['m'], numbers['d'])


@lru_cache(maxsize=64)
def _ordinal(year: int, month: int, day: int) -> int:
    """Number of days since 1970; years below 100 are in this century."""
    date = datetime.date(year + 2000 if year < 100 else year, month, day)
    return date.toordinal() - datetime.date(1970, 1, 1).toordinal()


def _time_of_day(match: re.Match[str]) -> tuple[int, bool]:
    """Return (time since midnight UTC [ns], whether it has a zone); raises ValueError."""
    if match['minutes']:
        return (int(match['minutes']) * 60 + int(match['seconds'])) * NS + _fraction(
            match['decimals']), False
    separator = match[3]
    hour, minute, second = int(match[2]), int(match[4] or match[7]), int(match[5] or match[8] or 0)
    if separator in ('.', '-') and match[5] is None:
        raise ValueError('it has no seconds')
    half = (match['half'] or '')[:1].lower()
    if half:
        if not 1 <= hour <= 12:
            raise ValueError(f'{hour} {half.upper()}M is not an hour')
        hour = hour % 12 + (12 if half == 'p' else 0)
    if hour > 24 or minute > 59 or second > 60:
        raise ValueError('it is not a time of day')
    total = (int(match['days'] or 0) * 24 + hour) * 3600 + minute * 60 + second
    if shift := match['shift']:
        minutes = int(shift[1:3]) * 60 + int(shift[3:].lstrip(':') or 0)
        total -= minutes * 60 if shift[0] == '+' else -minutes * 60
    return total * NS + _fraction(match[6] or match[9] or ''), bool(shift or match['zone'])


def _fraction(digits: str) -> int:
    """Decimals of a second [ns]."""
    return int(digits[:9].ljust(9, '0'))


def date_order(texts: Iterable[str]) -> str | None:
    """Order of day, month and year in all times of a table; None if several are possible."""
    orders = set(DATE_ORDERS)
    # Most rows have the date of the previous row.
    for first, separator, second, third in {
            m.group(1, 2, 3, 4) for text in texts
            if (m := _DATE(' '.join(text[:MAX_LENGTH].split()))) and m[1]}:
        if len(first) > 2 or not orders:
            orders &= {'ymd'}
            continue
        if len(third) > 2:
            orders -= {'ymd'}
        if separator == '.':
            orders &= {'dmy'}
        for order in tuple(orders):
            numbers = dict(zip(order, (int(first), int(second), int(third)), strict=True))
            if numbers['m'] > 12 or numbers['d'] > 31:
                orders.discard(order)
    return 'ymd' if len(orders) == 3 else orders.pop() if len(orders) == 1 else None
