"""Dates and times of day as text, in the forms that loggers, spreadsheets and databases write."""

import datetime
import re
from collections.abc import Iterable
from functools import lru_cache

from mag_tracking.units import NS

DATE_ORDERS = ('dmy', 'mdy', 'ymd')
"""Orders of day, month and year in a date of three numbers."""
FORMS = ('2026-05-03T23:56:01.250Z (ISO 8601), 2026-05-03 23:56:01.250, 03.05.2026 23:56:01.250, '
         '05/03/2026 11:56:01.250 PM, 03 May 2026 23:56:01.250 and 23:56:01.250')
"""Examples of the accepted forms, for messages."""
MAX_LENGTH = 80
"""Maximum length of a time."""
DAY_NS = 86400 * NS
"""Nanoseconds per day."""
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
    """Convert a date and time (ns since 1970), or a time of day (ns since midnight), to
    nanoseconds.

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
