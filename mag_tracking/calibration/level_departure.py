"""Departure of a sensor from its background, and the level at the end of the departure."""

from collections import deque
from collections.abc import Iterable
from math import inf

from mag_tracking.arrays import Record
from mag_tracking.calibration.background_level import BackgroundLevel
from mag_tracking.calibration.blocks import Block, stacked
from mag_tracking.calibration.drift import FormerLevel
from mag_tracking.calibration.frequent_level import MIN_DURATION_RATIO
from mag_tracking.calibration.level_change import NO_CHANGE, ChangeEvaluator, level_change
from mag_tracking.units import NS

MIN_RELEARN_S = 10.0
"""[s] Minimum duration of another steady level that replaces a resumed or briefly observed
background."""

SHORTENED_FRACTION = 2.0 / 3.0
"""Required duration of the level after a vehicle has departed, and of a former level, as a fraction
of the usual duration."""

MAX_EVALUATED_BLOCKS = 240
"""Maximum number of blocks (a minute of the usual length) for which arrivals and departures are
evaluated, since each evaluation uses all blocks."""


class LevelDeparture:
    """Interval in which the blocks of a sensor depart from its frozen background.

    Attributes
    ----------
    blocks : blocks since the departure began
    former : previous background
    has_arrived : whether a vehicle has arrived and is present
    was_steady : whether the sensor stayed at another steady level for the required duration
    departed_at : s, time by which a vehicle that was part of the first background had departed
    """

    def __init__(self, learn: float, relearn: float, state: Record, level: BackgroundLevel,
                 evaluate_change: ChangeEvaluator) -> None:
        self._learn, self._relearn = learn, relearn
        self._state, self._level = state, level
        self._evaluate_change = evaluate_change
        self.forget()

    def forget(self) -> None:
        """Reset all attributes, including the former level."""
        self.departed_at: float | None = None
        self.former: FormerLevel | None = None
        self._evaluate_change(NO_CHANGE)
        self.end()

    def end(self) -> None:
        """End the departure, because the sensor is at its background again."""
        self.blocks: deque[Block] = deque()
        self._blocks_before: list[Block] = []
        self._has_first_block = True
        self.has_arrived = self.was_steady = False

    def add(self, block: Block, before: Iterable[Block]) -> None:
        """Add a block; `before` are the blocks before the departure, used with its first block."""
        if not self.blocks:
            self._blocks_before = list(before)
        self.blocks.append(block)

    def shorten(self) -> None:
        """Discard the first block; the later blocks may be steady."""
        self.blocks.popleft()
        self._has_first_block = False

    def steady_end(self, ratio: float = 1.0) -> deque[Block] | None:
        """Latest blocks if steady for `ratio` of the usual time, else None; set `was_steady`."""
        new_blocks = self._level.steady_end(self.blocks, ratio * self._learn)
        self.was_steady |= new_blocks is not None
        return new_blocks

    def relearn_time(self, observed_s: float, relearns_soon: bool) -> float:
        """Time [s] on another steady level until it becomes the background; 0 if it never does.

        `observed_s` is the time for which the background was observed; `relearns_soon` means that
        the sensor may have been moved, or its surroundings changed.
        """
        if relearns_soon:
            return min(self._relearn or inf, max(self._learn, MIN_RELEARN_S))
        if self.has_arrived:
            return self._relearn
        # A vehicle present from the start may have departed.
        return self._relearn and min(
            self._relearn, max(self._learn, MIN_RELEARN_S, MIN_DURATION_RATIO * observed_s))

    def former_observed_s(self) -> float:
        """Duration [s] for which the former level was observed; 0 if the latest block left it."""
        former = self.former
        is_at_former = former is not None and former.is_at(self.blocks[-1], self._level.limits)
        return former.observed_s if former is not None and is_at_former else 0.0

    def has_departed(self, new_blocks: deque[Block]) -> bool | None:
        """Determine and store whether a vehicle in the background has departed.

        False if a vehicle has arrived, None if unknown.
        """
        if self.has_arrived or not self._has_first_block or len(self.blocks) > MAX_EVALUATED_BLOCKS:
            return False if self.has_arrived else None
        blocks = stacked([*self._blocks_before, *self.blocks])
        has_departed = self._evaluate_change(level_change(
            blocks, len(new_blocks), self._level.at_all(blocks.time), self._state['noise_std'],
            int(self._state['first_ns']) / NS))
        self.has_arrived = has_departed is False
        if has_departed and self.former is None and self.departed_at is None:
            self.departed_at = new_blocks[0].time
        return has_departed
