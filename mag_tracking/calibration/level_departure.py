"""The stretch over which a sensor is off its background, and the level that it may end with."""

from collections import deque
from collections.abc import Iterable
from math import inf

from mag_tracking.arrays import Record
from mag_tracking.calibration.background_level import BackgroundLevel
from mag_tracking.calibration.blocks import Block, stacked
from mag_tracking.calibration.drift import FormerLevel
from mag_tracking.calibration.frequent_level import MORE
from mag_tracking.calibration.level_change import NO_CHANGE, ChangeEvaluator, level_change
from mag_tracking.units import NS

MIN_RELEARN_S = 10.0
"""[s] A background that was resumed, or seen for a moment only, gives way to another steady level
after this time at the earliest."""

SOONER = 2.0 / 3.0
"""Where a vehicle has left, or a former level is back, the level has to last for this share of the
usual time only."""

MAX_JUDGED = 240
"""Blocks, a minute of the usual length, after which it is not judged any more whether something
came or left: each judgement looks at all of them."""


class LevelDeparture:
    """Blocks that are off the background, since it froze.

    Attributes
    ----------
    blocks : deque of Block
    former : FormerLevel or None
        The level before the present one.
    has_come : bool
        Whether a vehicle has come and stands now.
    was_steady : bool
        Whether the sensor was at another level for long enough.
    departed_at : float or None, s
        When a vehicle that had stood there since the beginning was gone.
    """

    def __init__(self, learn: float, relearn: float, state: Record, level: BackgroundLevel,
                 evaluate_change: ChangeEvaluator) -> None:
        """`learn`, `relearn` [s], `evaluate_change`: as `RunningBackground` has them."""
        self._learn, self._relearn = learn, relearn
        self._state, self._level = state, level
        self._evaluate_change = evaluate_change
        self.forget()

    def forget(self) -> None:
        """Drop all, also the former level."""
        self.departed_at: float | None = None
        self.former: FormerLevel | None = None
        self._evaluate_change(NO_CHANGE)
        self.end()

    def end(self) -> None:
        """The sensor is at its background again."""
        self.blocks: deque[Block] = deque()
        self._before: list[Block] = []
        self._has_begin = True
        self.has_come = self.was_steady = False

    def add(self, block: Block, before: Iterable[Block]) -> None:
        """Take a block that is off, and those `before` the first one."""
        if not self.blocks:
            self._before = list(before)
        self.blocks.append(block)

    def shorten(self) -> None:
        """Drop the first block: those after it may be steady."""
        self.blocks.popleft()
        self._has_begin = False

    def steady_end(self, share: float = 1.0) -> deque[Block] | None:
        """The latest blocks, over a `share` of the usual time, if they are of a steady level."""
        latest = self._level.steady_end(self.blocks, share * self._learn)
        self.was_steady |= latest is not None
        return latest

    def longest(self, seen_s: float, relearns_soon: bool) -> float:
        """[s] After how long another steady level is the background; 0 = never.

        `seen_s` [s] is for how long the background was seen; it `relearns_soon` where the sensor
        may have been moved, or its surroundings changed, since.
        """
        if relearns_soon:
            return min(self._relearn or inf, max(self._learn, MIN_RELEARN_S))
        if self.has_come:
            return self._relearn
        # A vehicle that stood there in the beginning may have left.
        return self._relearn and min(
            self._relearn, max(self._learn, MIN_RELEARN_S, MORE * seen_s))

    def former_seen_s(self) -> float:
        """[s] For how long the level before the present one was seen, if the latest block is at it;
        else 0.
        """
        former = self.former
        is_at_it = former is not None and former.is_at(self.blocks[-1], self._level.limits)
        return former.seen_s if former is not None and is_at_it else 0.0

    def has_departed(self, latest: deque[Block]) -> bool | None:
        """Whether a vehicle that was in the background has left before the `latest` blocks; False:
        one has come; None: unknown. An answer is remembered.
        """
        if self.has_come or not self._has_begin or len(self.blocks) > MAX_JUDGED:
            return False if self.has_come else None
        blocks = stacked([*self._before, *self.blocks])
        has_departed = self._evaluate_change(level_change(
            blocks, len(latest), self._level.at_all(blocks.time), self._state['noise_std'],
            int(self._state['first_ns']) / NS))
        self.has_come = has_departed is False
        if has_departed and self.former is None and self.departed_at is None:
            self.departed_at = latest[0].time
        return has_departed
