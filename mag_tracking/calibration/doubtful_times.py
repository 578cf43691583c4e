"""Intervals, as timestamps of readings, in which the input of a sensor was doubtful; the tracker
marks tracks that use it as ambiguous."""

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
    """Return at most `max_intervals`, updated with the state from a timestamp on."""
    is_open = bool(times) and times[-1][1] is None
    if is_doubtful and not is_open:
        return (*times, (stamp_ns, None))[-max_intervals:]
    if is_open and not is_doubtful:
        return (*times[:-1], (times[-1][0], stamp_ns))
    return times


def doubtful_since(times: DoubtfulTimes, since_ns: int) -> DoubtfulTimes:
    """Add an open interval from `since_ns` on, which replaces all later intervals."""
    earlier = tuple((begin, end) for begin, end in times if begin < since_ns)
    if earlier and (earlier[-1][1] is None or earlier[-1][1] >= since_ns):
        return (*earlier[:-1], (earlier[-1][0], None))
    return (*earlier, (since_ns, None))[-MAX_INTERVALS:]


def merged(earlier: Mapping[str, DoubtfulTimes], latest: Mapping[str, DoubtfulTimes]
           ) -> dict[str, DoubtfulTimes]:
    """Merge earlier and latest doubtful intervals of sensors.

    A latest interval replaces an earlier one that begins at the same time or within it. An earlier
    open interval ends where the next one begins, or is removed if the sensor has no latest
    intervals.
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
    """Shift intervals by a clock offset, which is added to all times."""
    return tuple((begin + ns, None if end is None else end + ns) for begin, end in times)


def are_doubtful(times: DoubtfulTimes, stamp_ns: int) -> bool:
    """Whether the background was doubtful at a timestamp."""
    return any(begin <= stamp_ns and (end is None or stamp_ns < end) for begin, end in times)
