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

    Parameters
    ----------
    learn, relearn : float, s
        As for `RunningBackground`.
    state : SENSOR record
        State of the sensor.
    level : BackgroundLevel
        Background of the sensor.
    evaluate_change : ChangeEvaluator
        Classifies a level change of the sensor.

    Attributes
    ----------
    blocks : deque of Block
        Blocks since the departure began.
    former : FormerLevel or None
        Previous background.
    has_arrived : bool
        Whether a vehicle has arrived and is present.
    was_steady : bool
        Whether the sensor stayed at another steady level for the required duration during the
        departure.
    departed_at : float or None, s
        Time by which a vehicle that was part of the first background had departed; None if no such
        departure was detected.
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
        """Add a block to the departure.

        Parameters
        ----------
        block : Block
        before : iterable of Block
            Blocks immediately before the departure; used only with the first block of the
            departure.
        """
        if not self.blocks:
            self._blocks_before = list(before)
        self.blocks.append(block)

    def shorten(self) -> None:
        """Discard the first block; the later blocks may be steady."""
        self.blocks.popleft()
        self._has_first_block = False

    def steady_end(self, ratio: float = 1.0) -> deque[Block] | None:
        """Return the latest blocks if they are at a steady level, and update `was_steady`.

        Parameters
        ----------
        ratio : float
            Required duration relative to the usual duration.

        Returns
        -------
        deque of Block or None
            None if the latest blocks are not steady for the required duration.
        """
        new_blocks = self._level.steady_end(self.blocks, ratio * self._learn)
        self.was_steady |= new_blocks is not None
        return new_blocks

    def relearn_time(self, observed_s: float, relearns_soon: bool) -> float:
        """Time on another steady level after which that level becomes the background.

        Parameters
        ----------
        observed_s : float, s
            Duration for which the background was observed.
        relearns_soon : bool
            Whether the sensor may have been moved, or its surroundings changed.

        Returns
        -------
        float, s
            0 if no other level becomes the background.
        """
        if relearns_soon:
            return min(self._relearn or inf, max(self._learn, MIN_RELEARN_S))
        if self.has_arrived:
            return self._relearn
        # A vehicle present from the start may have departed.
        return self._relearn and min(
            self._relearn, max(self._learn, MIN_RELEARN_S, MIN_DURATION_RATIO * observed_s))

    def former_observed_s(self) -> float:
        """Duration for which the former level was observed, if the latest block is at that level.

        Returns
        -------
        float, s
            0 if the latest block is not at the former level.
        """
        former = self.former
        is_at_former = former is not None and former.is_at(self.blocks[-1], self._level.limits)
        return former.observed_s if former is not None and is_at_former else 0.0

    def has_departed(self, new_blocks: deque[Block]) -> bool | None:
        """Determine and store whether a vehicle that was part of the background has departed.

        Parameters
        ----------
        new_blocks : deque of Block
            Blocks of the new level.

        Returns
        -------
        bool or None
            True: a vehicle has departed. False: a vehicle has arrived. None: unknown.
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
