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
    """The `times`, and all from `since_ns` on."""
    earlier = tuple((begin, end) for begin, end in times if begin < since_ns)
    if earlier and (earlier[-1][1] is None or earlier[-1][1] >= since_ns):
        return (*earlier[:-1], (earlier[-1][0], None))
    return (*earlier, (since_ns, None))[-MOST:]


def merged(earlier: Mapping[str, DoubtfulTimes], latest: Mapping[str, DoubtfulTimes]
           ) -> dict[str, DoubtfulTimes]:
    """{sensor: all its stretches}; where two begin together, the latest knows better."""
    return {name: tuple(sorted({**dict(earlier.get(name, ())), **dict(latest.get(name, ()))}.items()
                               ))[-MOST:] for name in {**earlier, **latest}}


def shifted(times: DoubtfulTimes, ns: int) -> DoubtfulTimes:
    """The `times` by a clock that is `ns` [ns] ahead."""
    return tuple((begin + ns, None if end is None else end + ns) for begin, end in times)


def are_doubtful(times: DoubtfulTimes, stamp_ns: int) -> bool:
    """Whether the background was doubtful at `stamp_ns`."""
    return any(begin <= stamp_ns and (end is None or stamp_ns < end) for begin, end in times)
