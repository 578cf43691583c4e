"""Times of a table: exact conversion to nanoseconds, the unit found, and their order."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Context, Decimal, InvalidOperation
from fractions import Fraction
from typing import NamedTuple

from mag_tracking import units
from mag_tracking.errors import RecordingError, SettingsError
from mag_tracking.quantities import occurrences
from mag_tracking.recording.table_text import is_missing, is_number, plain_number

PLAUSIBLE_STEP_S = (1e-4, 0.67)
"""Range of intervals between readings that need no question about the unit of the time [s]."""
_SUB = 10**15
"""Resolution of numbers, as a fraction of the unit."""
_EXACT = Context(prec=50)
_DIGITS_OF_A_DATE = re.compile(
    '(?:19|20)[0-9]{2}[01][0-9][0-3][0-9][0-2][0-9][0-5][0-9][0-5][0-9](?:[.]?[0-9]+)?').fullmatch
"""yyyymmddhhmmss and decimals."""
_EPOCHS = (
    ('d', 36526, 58484, 25569 * units.DAY_NS, 'days since 1900 (spreadsheet)'),
    ('d', 730486, 752444, 719529 * units.DAY_NS, 'days since the year 0 (MATLAB)'),
    ('s', 3.03e9, 4.23e9, 2082844800 * units.NS, 's since 1904 (LabVIEW)'))
"""Unit, range of values in this century, time to subtract [ns], and name of epochs before 1970."""
_COUNTER_LIMITS = (2**15, 2**16, 2**20, 2**24, 2**31, 2**32)
_CLOCK_LIMITS_S = (60, 3600, 86400, 7 * 86400)
_TIME_OF_DAY = re.compile('[0-2][0-9][0-5][0-9][0-5][0-9](?:[.][0-9]+)?').fullmatch
"""hhmmss and decimals, as in NMEA 0183."""
JUMPS = ('split', 'sort')
"""Meanings of a time that runs backwards: the clock restarted, or the rows are out of order."""
MAX_GAP_NS = 5 * 365 * units.DAY_NS
"""Maximum interval between two readings [ns]. A clock that is set after its start jumps farther."""
MAX_STEPS = 5
"""Maximum interval, in median intervals, that counts as uninterrupted."""
MAX_EQUAL_FRACTION = 0.5
"""Maximum fraction of times that equal the previous time of the sensor."""
_REMEDY = ('. If the clock restarted or was set, give --jumps split (each part becomes a '
           'recording); if the counter returns to 0 after N, --wrap N; if the rows are out of '
           'order, --jumps sort')


class Times(NamedTuple):
    """Times of the rows of a table, exact integers."""

    values: list[int | None]
    """Time in `scale` ns; None if the cell is not a time."""
    scale: Fraction
    """Nanoseconds per unit of `values`."""
    offset_ns: int
    """Time to subtract [ns]."""
    unit: int
    """Number of units of `values` per unit of the table."""
    limits: tuple[int, ...]
    """Values at which the time may restart at 0."""
    notes: list[str]

    def stamps(self, values: Iterable[int]) -> list[int]:
        """Convert values to timestamps, ns."""
        numerator, denominator = self.scale.numerator, self.scale.denominator
        half = denominator // 2
        return [(v * numerator + half) // denominator - self.offset_ns for v in values]


def _successive(values: Iterable[int | None], keys: Iterable[int]) -> Iterator[tuple[int, int]]:
    """Iterate over the pairs of successive times of the same series (`keys`)."""
    last: dict[int, int] = {}
    for value, key in zip(values, keys, strict=True):
        if value is not None:
            if key in last:
                yield last[key], value
            last[key] = value


def _step_of(values: Sequence[int | None], keys: Sequence[int]) -> int:
    """Median interval between successive times of a series; 0 if no time increases."""
    steps = sorted(abs(b - a) for a, b in _successive(values, keys) if a != b)
    return steps[len(steps) // 2] if steps else 0


def read_times(where: str, texts: Sequence[str], keys: Sequence[int], decimal: str, unit: str,
               header_unit: str, order: str) -> Times:
    """Convert the times of a table, whose series (sensors) are `keys`.

    An empty `unit` or `order` of a date is found; if ambiguous, RecordingError names the option.
    """
    if order and order not in units.DATE_ORDERS:
        raise SettingsError(f'--date-order: expected one of {", ".join(units.DATE_ORDERS)}, got '
                            f'{order!r}')
    n_numbers = sum(is_number(t) for t in texts)
    if n_numbers and all(_DIGITS_OF_A_DATE(t) or is_missing(t) for t in texts):
        texts, n_numbers = [f'{t[:8]} {t[8:14]}.{t[14:].lstrip(".")}' for t in texts], 0
    if n_numbers == len(texts) and all(map(_TIME_OF_DAY, texts)) and any(
            40.0 < float(b) - float(a) < 42.0 or float(b) - float(a) < -235950.0
            for a, b in zip(texts, texts[1:], strict=False)):
        # As a number of seconds, the time would jump by 41 s after each minute.
        n_numbers = 0
    if 2 * n_numbers < sum(not is_missing(t) for t in texts):
        return _read_dates(where, texts, order)
    values = [_exact(t, decimal) for t in texts]
    # Several readings may share a coarse time.
    step = round(_step_of(values, keys) * min(1.0, len(set(values)) * len(set(keys)) / len(values)))
    scale, offset, notes = _unit_of(where, values, step, unit, header_unit)
    limits = (*(n * _SUB for n in _COUNTER_LIMITS),
              *(round(s * units.NS / scale) for s in _CLOCK_LIMITS_S))
    return Times(values, scale, offset, _SUB, limits, notes)


def _read_dates(where: str, texts: Sequence[str], order: str) -> Times:
    found = order or units.date_order(texts)
    if found is None:
        raise RecordingError(
            f'{where}: the order of day, month and year is ambiguous in {texts[0]!r}; give '
            '--date-order dmy, mdy or ymd')
    values: list[int | None] = []
    kinds = set()
    fault = ''
    for text in texts:
        try:
            time_ns, *kind = units.parse_time(text, found)
        except ValueError as error:
            values.append(None)
            fault = fault or f'{text[:40]!r}: {error}'
        else:
            values.append(time_ns)
            kinds.add(tuple(kind))
    if not kinds or len({has_date for has_date, _ in kinds}) > 1:
        raise RecordingError(f'{where}: {fault or "only some times have a date"}; accepted are '
                             f'numbers (--time-unit) and {units.FORMS}')
    has_date = any(has_date for has_date, _ in kinds)
    has_zone = all(has_zone for _, has_zone in kinds)
    note = 'date and time' if has_date else 'time of day'
    note += ' in UTC' if has_zone else ' without time zone, taken as UTC' if has_date else ''
    limits = () if has_date else (3600 * units.NS, units.DAY_NS // 2, units.DAY_NS)
    return Times(values, Fraction(1), 0, units.NS, limits, [note])


def _exact(text: str, decimal: str) -> int | None:
    """Convert a number to units of 1 / `_SUB`, exactly; None if it is not a number."""
    try:
        number = Decimal(plain_number(text, decimal))
        if not number.is_finite() or number.adjusted() > 30 or '_' in text:
            return None
        return int(number.scaleb(15, _EXACT).to_integral_value())
    except InvalidOperation:
        return None


def _unit_of(where: str, values: Sequence[int | None], step: int, unit: str, header_unit: str
             ) -> tuple[Fraction, int, list[str]]:
    """Return (ns per unit of `values`, time to subtract [ns], notes about the unit)."""
    numbers = [v / _SUB for v in values if v is not None]
    low, high = (min(numbers), max(numbers)) if numbers else (0.0, 0.0)
    stated = unit or header_unit
    step_s = step / _SUB
    known = (units.time_unit(stated) or stated) if stated else ''
    epochs = list(_EPOCHS)
    if (since := units.unit_since_1970(low)) and since == units.unit_since_1970(high):
        epochs.append((since, low, high, 0, f'{since} since 1970'))
    for name, first, last, offset, title in epochs:
        seconds = step_s * units.TIME_UNITS[name] / units.NS
        if first <= low <= high <= last and known in ('', name) and (
                not step or 1e-4 <= seconds <= 100.0 or known):
            return Fraction(units.TIME_UNITS[name], _SUB), offset, [f'time in {title}']
    if stated:
        scale = units.time_scale(stated, '--time-unit')
        notes = [f'time in {stated}{"" if unit else " (header)"}']
        others = _plausible(step_s, high - low)
        if step and not 1e-4 <= step_s * float(scale) / units.NS <= 2.0 and others:
            rate = _rates(step_s * float(scale) / units.NS, (high - low) * float(scale) / units.NS)
            notes.append(f'warning: in {stated}, the times give {rate}; --time-unit may be wrong: '
                         f'{others}')
        return scale / _SUB, 0, notes
    if not step or PLAUSIBLE_STEP_S[0] <= step_s <= PLAUSIBLE_STEP_S[1]:
        return Fraction(units.NS, _SUB), 0, ['time in s']
    others = _plausible(step_s, high - low)
    raise RecordingError(
        f'{where}: as seconds, the times give {_rates(step_s, high - low)}. If that is right, give '
        f'--time-unit s; ' + (f'otherwise --time-unit with the unit: {others}' if others else
                              f'otherwise --time-unit with one of {", ".join(units.TIME_UNITS)}'))


def _plausible(step: float, span: float) -> str:
    return ', '.join(
        f'{name} ({_rates(step * ns / units.NS, span * ns / units.NS)})'
        for name, ns in units.TIME_UNITS.items()
        if PLAUSIBLE_STEP_S[0] <= step * ns / units.NS <= PLAUSIBLE_STEP_S[1])


def _rates(step_s: float, span_s: float) -> str:
    return f'{1.0 / step_s if step_s else 0.0:.4g} Hz over {span_text(span_s)}'


def span_text(span_s: float) -> str:
    """Describe a duration, such as '14 s' or '3.9 h'."""
    for unit, length in (('years', 31557600.0), ('days', 86400.0), ('h', 3600.0), ('s', 1.0),
                         ('ms', 1e-3), ('us', 1e-6)):
        if span_s >= 1.5 * length or unit == 'us':
            return f'{span_s / length:.4g} {unit}'
    return ''


def check_range(where: str, line: int, stamp_ns: int) -> None:
    """Raise RecordingError if a time is not in the range of ROS headers."""
    if not 0 <= stamp_ns <= units.LATEST_NS:
        raise RecordingError(f'{where}: row {line}: {stamp_ns / units.NS:.6g} s is not a valid '
                             'time since 1970; check --time-unit')


@dataclass
class OrderedTimes:
    """Times that do not run backwards within a session."""

    values: list[int]
    session: list[int]
    rows: list[int]
    """Indices of the rows, in the order of `values`."""
    notes: list[str] = field(default_factory=list)
    outliers: list[int] = field(default_factory=list)
    """Indices of rows whose time contradicts those before and after."""


def order_times(where: str, times: Times, texts: Sequence[str], keys: Sequence[int],
                lines: Sequence[int], wrap: int = 0, jumps: str = '') -> OrderedTimes:
    """Unwrap times that run backwards, or divide them into sessions; sort them only on request.

    Rows without a time are left out. `wrap` is the number at which the time returns to 0; by
    default, usual numbers are recognised. Raises RecordingError if a time runs backwards for an
    unknown reason or jumps ahead by years.
    """
    if jumps and jumps not in JUMPS:
        raise SettingsError(f'--jumps: expected {" or ".join(JUMPS)}, got {jumps!r}')
    raw = {k: value for k, value in enumerate(times.values) if value is not None}
    tolerance = MAX_STEPS * _step_of(times.values, keys)
    out = _usable_rows(raw, keys, -1 if jumps or wrap else tolerance)
    last: dict[int, int] = {}
    offset: Counter[int] = Counter()
    session: Counter[int] = Counter()
    wraps: Counter[int] = Counter()
    for k in out.rows:
        value, key = raw[k], keys[k]
        change = value - raw[last[key]] if key in last else 0
        limit = 0 if change >= 0 else wrap * times.unit or next(
            (n for n in times.limits if 0 < change + n <= tolerance), 0)
        if limit:
            offset[key] += limit
            wraps[limit] += 1
        elif change < 0 or change * times.scale > MAX_GAP_NS:
            if not jumps:
                direction = 'runs backwards' if change < 0 else 'jumps ahead'
                raise RecordingError(
                    f'{where}: row {lines[k]}: the time {direction}, from {texts[last[key]]} in '
                    f'row {lines[last[key]]} to {texts[k]}{_REMEDY}')
            if jumps == 'split':
                session[key] += 1
                offset[key] = 0
        last[key] = k
        out.values.append(value + offset[key])
        out.session.append(session[key])
    if len({session[key] for key in last}) > 1:
        raise RecordingError(f'{where}: the clocks of the sensors restart at different rows; '
                             'import the rows of each sensor separately')
    out.notes += [f'the time restarts after {n / times.unit:.12g} ({occurrences(count)}), unwrapped'
                  for n, count in wraps.items()]
    return out


def _usable_rows(raw: dict[int, int], keys: Sequence[int], tolerance: int) -> OrderedTimes:
    """Order the rows, and leave out those with outlying times unless `tolerance` is negative."""
    rows = list(raw)
    out = OrderedTimes([], [], rows)
    if _is_reversed(raw, rows, keys):
        rows.reverse()
        out.notes.append('rows from the last to the first')
    if tolerance >= 0:
        out.outliers = _outliers(raw, rows, keys, tolerance)
        dropped = set(out.outliers)
        out.rows = [k for k in rows if k not in dropped]
    return out


def _is_reversed(raw: dict[int, int], rows: Sequence[int], keys: Sequence[int]) -> bool:
    """Whether all times decrease, as in an export with the newest row first."""
    n_earlier = 0
    for before, value in _successive((raw[k] for k in rows), (keys[k] for k in rows)):
        if value > before:
            return False
        n_earlier += value < before
    return n_earlier > 1


def _outliers(raw: dict[int, int], rows: Sequence[int], keys: Sequence[int], tolerance: int
              ) -> list[int]:
    """Rows whose single time jumps far away, while the next time continues the series."""
    series: dict[int, list[int]] = {}
    for k in rows:
        series.setdefault(keys[k], []).append(k)
    return [k for s in series.values() for before, k, after in zip(s, s[1:], s[2:], strict=False)
            if 0 <= raw[after] - raw[before] <= tolerance and not
            raw[before] - tolerance <= raw[k] <= raw[after] + tolerance]


def check_resolution(where: str, texts: Sequence[str], values: Sequence[int], keys: Sequence[int]
                     ) -> None:
    """Raise RecordingError, with cause and remedy, if more than `MAX_EQUAL_FRACTION` of the times
    equal the previous one of the series (`keys`)."""
    is_equal = [a == b for a, b in _successive(values, keys)]
    equal = sum(is_equal) / len(is_equal) if is_equal else 0.0
    if equal <= MAX_EQUAL_FRACTION:
        return
    coarse = 'all times are equal' if len(set(values)) == 1 else \
        'their resolution is too coarse, or rows are repeated'
    cause = next((f'a spreadsheet rounded them to {text}; write the column with all digits '
                  '(as a number, not in scientific notation)' for text in texts
                  if 'e+' in text.lower()), f'{coarse}; write more digits of the time')
    raise RecordingError(
        f'{where}: {100.0 * equal:.0f} % of the times equal the previous time of the sensor, such '
        f'as {texts[0]}: {cause}, or give the rate of the readings with --rate HZ, which spaces '
        'them evenly')
