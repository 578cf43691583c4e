"""Intervals in which the input of a sensor was doubtful, as timestamps of its readings.

The stages and programs that diagnose the input report the intervals by reason and sensor. The
tracker marks the tracks that use such readings as ambiguous, for the same reason.
"""

from collections.abc import Mapping
from typing import TypeAlias

DoubtfulTimes: TypeAlias = tuple[tuple[int, int | None], ...]
"""((begin, end) [ns], ...), oldest first, ends excluded; an end of None is not known yet."""

InputDoubts: TypeAlias = Mapping[str, Mapping[str, DoubtfulTimes]]
"""{reason: {sensor: intervals}}; the reasons are names of `stages.track.doubts`."""

DOUBTFUL_BACKGROUND = 'doubtful_background'
CONTRADICTS_EARTH_FIELD = 'contradicts_earth_field'
WRONG_TIMESTAMPS = 'wrong_timestamps'
"""Reasons why the input of a sensor is doubtful."""

MAX_INTERVALS = 16
"""Maximum number of intervals; the oldest intervals are removed."""


def updated(times: DoubtfulTimes, stamp_ns: int, is_doubtful: bool,
            max_intervals: int = MAX_INTERVALS) -> DoubtfulTimes:
    """Return the intervals, updated with the state of the background at a timestamp.

    Parameters
    ----------
    times : DoubtfulTimes
    stamp_ns : int, ns
        Timestamp from which the state applies.
    is_doubtful : bool
        Whether the background is doubtful from then on.
    max_intervals : int
        Maximum number of intervals; the oldest intervals are removed.

    Returns
    -------
    DoubtfulTimes
    """
    is_open = bool(times) and times[-1][1] is None
    if is_doubtful and not is_open:
        return (*times, (stamp_ns, None))[-max_intervals:]
    if is_open and not is_doubtful:
        return (*times[:-1], (times[-1][0], stamp_ns))
    return times


def doubtful_since(times: DoubtfulTimes, since_ns: int) -> DoubtfulTimes:
    """Add an open interval that begins at a given time, and return the intervals.

    Parameters
    ----------
    times : DoubtfulTimes
    since_ns : int, ns
        Start of the open interval, which replaces all later intervals.

    Returns
    -------
    DoubtfulTimes
    """
    earlier = tuple((begin, end) for begin, end in times if begin < since_ns)
    if earlier and (earlier[-1][1] is None or earlier[-1][1] >= since_ns):
        return (*earlier[:-1], (earlier[-1][0], None))
    return (*earlier, (since_ns, None))[-MAX_INTERVALS:]


def merged(earlier: Mapping[str, DoubtfulTimes], latest: Mapping[str, DoubtfulTimes]
           ) -> dict[str, DoubtfulTimes]:
    """Merge earlier and latest doubtful intervals of sensors.

    An interval in `latest` replaces an earlier interval that begins at the same time or within it.
    If the end of an earlier interval is missing, the interval ends where the next one begins. If
    a sensor has no latest intervals, its background was replaced, and its open earlier interval is
    removed.

    Parameters
    ----------
    earlier : dict of str to DoubtfulTimes
    latest : dict of str to DoubtfulTimes
        The most recent intervals of each sensor.

    Returns
    -------
    dict of str to DoubtfulTimes
    """
    out = dict(earlier)
    for name, times in latest.items():
        retained = [(begin, end) for begin, end in earlier.get(name, ()) if not any(
            b <= begin and (e is None or begin < e or b == begin) for b, e in times)]
        segments: list[tuple[int, int | None]] = []
        for begin, end in sorted([*retained, *times], key=lambda segment: segment[0]):
            if segments and segments[-1][1] is None:
                segments[-1] = (segments[-1][0], begin)
            segments.append((begin, end))
        if segments and segments[-1][1] is None and not times:
            segments.pop()
        out[name] = tuple(segments[-MAX_INTERVALS:])
    return out


def shifted(times: DoubtfulTimes, ns: int) -> DoubtfulTimes:
    """Shift intervals by a clock offset.

    Parameters
    ----------
    times : DoubtfulTimes
    ns : int, ns
        Offset that is added to all times.

    Returns
    -------
    DoubtfulTimes
    """
    return tuple((begin + ns, None if end is None else end + ns) for begin, end in times)


def are_doubtful(times: DoubtfulTimes, stamp_ns: int) -> bool:
    """Whether the background was doubtful at a timestamp.

    Parameters
    ----------
    times : DoubtfulTimes
    stamp_ns : int, ns

    Returns
    -------
    bool
    """
    return any(begin <= stamp_ns and (end is None or stamp_ns < end) for begin, end in times)
