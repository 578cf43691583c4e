"""Order of the times of a table: counters that wrap, clocks that restart, equal times."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from mag_tracking.errors import RecordingError, SettingsError
from mag_tracking.quantities import occurrences
from mag_tracking.recording.table_times import Times, step_of
from mag_tracking.units import DAY_NS

JUMPS = ('split', 'sort')
"""Meanings of a time that runs backwards: the clock restarted, or the rows are out of order."""
MAX_GAP_NS = 5 * 365 * DAY_NS
"""Maximum interval between two readings [ns]. A clock that is set after its start jumps farther."""
MAX_STEPS = 5
"""Maximum interval, in median intervals, that counts as uninterrupted."""
MAX_EQUAL_FRACTION = 0.5
"""Maximum fraction of times that equal the previous time of the sensor."""


_REMEDY = ('. If the clock restarted or was set, give --jumps split (each part becomes a '
           'recording); if the counter returns to 0 after N, --wrap N; if the rows are out of '
           'order, --jumps sort')


@dataclass
class OrderedTimes:
    """Times that do not run backwards within a session."""

    values: list[int]
    session: list[int]
    """Session of each row, from 0."""
    rows: list[int]
    """Indices of the rows, in the order of `values`."""
    notes: list[str] = field(default_factory=list)
    outliers: list[int] = field(default_factory=list)
    """Indices of rows whose time contradicts those before and after."""


def order_times(where: str, times: Times, texts: Sequence[str], keys: Sequence[int],
                lines: Sequence[int], wrap: int = 0, jumps: str = '') -> OrderedTimes:
    """Unwrap times that run backwards, or divide them into sessions; sort them only on request.

    Rows without a time are left out. `keys` are the series (sensors) of the rows. `wrap` is the
    number at which the time returns to 0; by default, usual numbers are recognised. `jumps` is one
    of `JUMPS`. Raises RecordingError, with row and options, if a time runs backwards for an unknown
    reason or jumps ahead by years.
    """
    if jumps and jumps not in JUMPS:
        raise SettingsError(f'--jumps: expected {" or ".join(JUMPS)}, got {jumps!r}')
    raw = {k: value for k, value in enumerate(times.values) if value is not None}
    tolerance = MAX_STEPS * step_of(times.values, keys)
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
    last: dict[int, int] = {}
    n_earlier = 0
    for k in rows:
        if keys[k] in last:
            if raw[k] > last[keys[k]]:
                return False
            n_earlier += raw[k] < last[keys[k]]
        last[keys[k]] = raw[k]
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


def equal_fraction(values: Sequence[int], keys: Sequence[int]) -> float:
    """Fraction of times that equal the previous time of the same series (`keys`)."""
    last: dict[int, int] = {}
    n_equal = n = 0
    for value, key in zip(values, keys, strict=True):
        if key in last:
            n_equal += value == last[key]
            n += 1
        last[key] = value
    return n_equal / n if n else 0.0


def check_resolution(where: str, texts: Sequence[str], values: Sequence[int], keys: Sequence[int]
                     ) -> None:
    """Raise RecordingError, with cause and remedy, if more than `MAX_EQUAL_FRACTION` of the times
    equal the previous one of the series (`keys`)."""
    equal = equal_fraction(values, keys)
    if equal <= MAX_EQUAL_FRACTION:
        return
    n_distinct = len(set(values))
    cause = next((f'a spreadsheet rounded them to {text}; write the column with all digits '
                  '(as a number, not in scientific notation)' for text in texts
                  if 'e+' in text.lower()), '')
    coarse = 'all times are equal' if n_distinct == 1 else \
        'their resolution is too coarse, or rows are repeated'
    cause = cause or f'{coarse}; write more digits of the time'
    raise RecordingError(
        f'{where}: {100.0 * equal:.0f} % of the times equal the previous time of the sensor, such '
        f'as {texts[0]}: {cause}, or give the rate of the readings with --rate HZ, which spaces '
        'them evenly')
