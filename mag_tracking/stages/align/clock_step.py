"""Sensors whose clock steps ahead of all the others', told from a gap that all of them had.

Where stamps decide what is late, one clock that steps ahead would make all other sensors late.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.units import NEVER


class HeldSample(NamedTuple):
    """A sample that waits for the clocks of the other sensors."""

    stamp_ns: int
    field: FloatArray
    """(3,) [T]"""
    covariance: FloatArray
    """(3, 3) [T^2]"""


Passed = list[tuple[int, HeldSample]]


class ClockStepFilter:
    """Holds samples that jump ahead until it is known whether the other sensors jump, too.

    All others pass at once.
    """

    def __init__(self, n_sensors: int, limit: int, most: int) -> None:
        """`limit` [ns]: a longer jump is looked at, and samples are held for so long, by the stamps
        of the others or its own; `most` of a sensor are held."""
        self._limit = limit
        self._most = most
        # Of those that have passed: of each sensor, and of all.
        self.latest = np.full(n_sensors, NEVER)
        self.newest = NEVER
        # (sensor, sample, the newest stamp when it came), in the order in which they came.
        self._held: list[tuple[int, HeldSample, int]] = []
        # {sensor that is ahead: (the newest stamp, its own when that was first the newest)}
        self._quiet_since: dict[int, tuple[int, int]] = {}

    @property
    def n_held(self) -> int:
        """How many samples are held."""
        return len(self._held)

    @property
    def held(self) -> list[tuple[int, HeldSample, int]]:
        """Sensor, sample and the newest timestamp [ns] when it came, of each that is held."""
        return list(self._held)

    @property
    def is_calm(self) -> bool:
        """Whether nobody is ahead: what is no longer a jump than the limit passes."""
        if not self._held and not self._quiet_since:
            return True
        # What is known of one whose samples are all gone holds for that newest stamp only.
        return not self._held and all(
            newest != self.newest for newest, _ in self._quiet_since.values())

    def feed(self, i: int, sample: HeldSample) -> tuple[Passed, Passed]:
        """What is known by now of a sample of sensor `i`, and of those that are held.

        Returns
        -------
        passed, refused : lists of (i, sample)
            In the order in which they came.
        """
        stamp = sample.stamp_ns
        if not self._jumps(i, stamp):
            passed = self._pass([(i, sample)])
        else:
            self._held.append((i, sample, self.newest))
            if self._quiet_since.get(i, (NEVER,))[0] != self.newest:
                self._quiet_since[i] = self.newest, stamp
            if not (self._most_agree(stamp) or self._is_alone(i, stamp)):
                return [], self._too_old(i, stamp)
            # Who is ahead of these, too, does not pass with them.
            passed = self._pass(self._take_out(lambda _, s, __: s.stamp_ns <= stamp + self._limit))
        # It is back with the others: what it said of a time ahead of them was wrong. And whom they
        # did not follow for so long they will not follow. The first that is held is the oldest.
        if i in self._quiet_since or self._held and self.newest - self._held[0][2] > self._limit:
            self._quiet_since.pop(i, None)
            return passed, self._take_out(
                lambda j, _, newest: j == i or self.newest - newest > self._limit)
        return passed, []

    def flush(self) -> Passed:
        """[(i, sample)] of those that are held when nothing comes any more."""
        return self._pass(self._take_out(lambda *_: True))

    def _jumps(self, i: int, stamp: int) -> bool:
        """Whether a stamp is ahead of all that have passed."""
        if self.newest == NEVER or stamp <= self.newest + self._limit:
            return False
        # Of two, who is heard for the first time may as well be right.
        return self.latest[i] != NEVER or bool(self._held) or len(self._alive()) > 1

    def _pass(self, samples: Passed) -> Passed:
        """Note that `samples` are as they should be."""
        for i, sample in samples:
            self.latest[i] = sample.stamp_ns
            self.newest = max(self.newest, sample.stamp_ns)
        return samples

    def _alive(self) -> set[int]:
        """The sensors that have passed of late."""
        return {j for j, latest in enumerate(self.latest.tolist())
                if latest != NEVER and latest >= self.newest - self._limit}

    def _most_agree(self, stamp: int) -> bool:
        """Whether most of the living sensors have jumped to about this stamp."""
        agree = {j for j, s, _ in self._held if abs(s.stamp_ns - stamp) <= self._limit}
        return 2 * len(agree) > len(agree | self._alive())

    def _is_alone(self, i: int, stamp: int) -> bool:
        """Whether sensor `i` has been ahead for a while and no other has said anything since."""
        return stamp - self._quiet_since[i][1] >= self._limit

    def _too_old(self, i: int, stamp: int) -> Passed:
        """What of sensor `i` has been held for too long, or is one too many."""
        mine = [s for j, s, _ in self._held if j == i]
        first = mine[0] if len(mine) > self._most else None
        return self._take_out(lambda j, s, _: j == i and (
            s.stamp_ns < stamp - self._limit or s is first))

    def _take_out(self, is_meant: Callable[[int, HeldSample, int], bool]) -> Passed:
        """[(i, sample)] of those held that `is_meant`; they are held no more."""
        if not self._held:
            return []
        out = [h[:2] for h in self._held if is_meant(*h)]
        self._held = [h for h in self._held if not is_meant(*h)]
        return out
