"""When the background of a sensor was doubtful, by the timestamps of its readings."""

from collections.abc import Mapping
from typing import TypeAlias

DoubtfulTimes: TypeAlias = tuple[tuple[int, int | None], ...]
"""((begin, end) [ns], ...), oldest first, without the ends; an end of None is not known yet."""

MOST = 16
"""The latest stretches are kept."""


def noted(times: DoubtfulTimes, stamp_ns: int, is_doubtful: bool, most: int = MOST
          ) -> DoubtfulTimes:
    """The `times`, and from `stamp_ns` on as `is_doubtful` says; the latest `most` stretches."""
    is_open = bool(times) and times[-1][1] is None
    if is_doubtful and not is_open:
        return (*times, (stamp_ns, None))[-most:]
    if is_open and not is_doubtful:
        return (*times[:-1], (times[-1][0], stamp_ns))
    return times


def doubted_since(times: DoubtfulTimes, since_ns: int) -> DoubtfulTimes:
    """The `times`, with one open stretch from `since_ns` on in place of those after it."""
    earlier = tuple((begin, end) for begin, end in times if begin < since_ns)
    if earlier and (earlier[-1][1] is None or earlier[-1][1] >= since_ns):
        return (*earlier[:-1], (earlier[-1][0], None))
    return (*earlier, (since_ns, None))[-MOST:]


def merged(earlier: Mapping[str, DoubtfulTimes], latest: Mapping[str, DoubtfulTimes]
           ) -> dict[str, DoubtfulTimes]:
    """{sensor: all its stretches}; `latest` has the most recent ones.

    A stretch in `latest` replaces an earlier one that begins at the same time or during it. If the
    end of an earlier stretch is missing, it ends where the next begins. If `latest` has no stretch
    of a sensor, its background was replaced, and an open stretch is dropped.
    """
    out = dict(earlier)
    for name, times in latest.items():
        kept = [(begin, end) for begin, end in earlier.get(name, ())
                if not any(b <= begin and (e is None or begin < e or b == begin) for b, e in times)]
        segments: list[tuple[int, int | None]] = []
        for begin, end in sorted([*kept, *times], key=lambda segment: segment[0]):
            if segments and segments[-1][1] is None:
                segments[-1] = (segments[-1][0], begin)
            segments.append((begin, end))
        if segments and segments[-1][1] is None and not times:
            segments.pop()
        out[name] = tuple(segments[-MOST:])
    return out


def shifted(times: DoubtfulTimes, ns: int) -> DoubtfulTimes:
    """The `times` by a clock that is `ns` [ns] ahead."""
    return tuple((begin + ns, None if end is None else end + ns) for begin, end in times)


def are_doubtful(times: DoubtfulTimes, stamp_ns: int) -> bool:
    """Whether the background was doubtful at `stamp_ns`."""
    return any(begin <= stamp_ns and (end is None or stamp_ns < end) for begin, end in times)
