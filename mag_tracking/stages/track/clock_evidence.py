"""How far the clocks of the sensors are apart, by all the passes so far."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.stages.track.rigid_pass import (
    LEAST_WAY,
    LONGEST_OFFSET,
    MIDDLE_STD,
    RigidPass,
)

SURE = 4.0
"""Standard deviations at which clocks are called apart."""

MEMORY = 20
"""About so many passes count: clocks are set, and drift."""

KEPT = 1.0 - 1.0 / MEMORY

LOOSE_S = 1e3
"""[s] Deviation of a clock that nothing is known of."""


@dataclass(frozen=True)
class ClockOffset:
    """Two clocks that differ."""

    ahead: int
    behind: int
    """Rows of the two sensors."""
    offset_s: float
    """By how much the one is ahead of the other; positive."""
    std_s: float
    n_passes: int
    """That compared clocks."""

    def text(self, names: Sequence[str]) -> str:
        """A sentence about it; `names` are those of the sensors."""
        ahead, behind = names[self.ahead], names[self.behind]
        passes = f'{self.n_passes} passes' if self.n_passes > 1 else 'one pass'
        return (f'the clock of {ahead} seems {1e3 * self.offset_s:.0f} ms ahead of that of '
                f'{behind} (standard deviation {1e3 * self.std_s:.0f} ms, by {passes}), or one of '
                'the two is not where the network file says; tracks are ambiguous until that is '
                f'put right (clock_offset of {ahead}: {self.offset_s:.3f} more)')


class ClockEvidence:
    """The offsets of several passes, folded into one answer.

    A sensor that is not where the network file says looks like one with a wrong clock as long as
    all vehicles go the same way at the same speed.

    Attributes
    ----------
    apart : ClockOffset or None
        The two clocks that differ most; None where none differ for sure.
    """

    def __init__(self, n_sensors: int) -> None:
        # Information on the clocks' offsets, and its product with them.
        self._information = np.zeros((n_sensors, n_sensors))
        self._pull = np.zeros(n_sensors)
        # Passes that count, and the sum of one over their speeds.
        self._weight, self._slowness = 0.0, 0.0
        self._n_passes = 0
        self.apart: ClockOffset | None = None

    @property
    def apart_s(self) -> float:
        """[s] How far two clocks are apart, by two passes or more: one may have been of two
        vehicles.
        """
        if self.apart is None or self.apart.n_passes < 2:
            return 0.0
        return self.apart.offset_s

    def add(self, found: RigidPass, rows: IntArray) -> None:
        """Count a pass of the sensors `rows`.

        One that no straight path explains says nothing, nor one that is too slow to depend on
        clocks.
        """
        is_slow = found.speed * LONGEST_OFFSET < LEAST_WAY
        if is_slow or not (found.is_explained and found.is_straight):
            return
        self._information *= KEPT
        self._pull *= KEPT
        reference = rows[found.reference]
        for j in np.flatnonzero(~np.isnan(found.offset)):
            if j == found.reference:
                continue
            variance = found.widening * found.offset_std[j]**2 + (MIDDLE_STD / found.speed)**2
            direction = np.zeros(len(self._pull))
            direction[rows[j]], direction[reference] = 1.0, -1.0
            self._information += np.outer(direction, direction) / variance
            self._pull += direction * found.offset[j] / variance
        self._n_passes += 1
        self._weight = 1.0 + KEPT * self._weight
        self._slowness = 1.0 / found.speed + KEPT * self._slowness
        self.apart = self._apart()

    def _apart(self) -> ClockOffset | None:
        """The two clocks that differ most, by their deviation; None where none do for sure.

        An offset in which vehicles, as fast as those so far, go less than a metre is none.
        """
        # What all clocks have in common is arbitrary.
        loose = np.eye(len(self._pull)) / LOOSE_S**2
        covariance: FloatArray = np.linalg.inv(self._information + loose).astype(np.float64)
        offset = covariance @ self._pull
        difference = offset[:, None] - offset[None, :]
        std = _std_of_differences(covariance)
        ahead, behind = np.unravel_index(np.argmax(difference / std), difference.shape)
        found = float(difference[ahead, behind])
        if found < SURE * std[ahead, behind] or found < LEAST_WAY * self._slowness / self._weight:
            return None
        return ClockOffset(int(ahead), int(behind), found, float(std[ahead, behind]),
                           min(self._n_passes, MEMORY))


def _std_of_differences(covariance: FloatArray) -> FloatArray:
    """(n, n) [s]; infinite on the diagonal."""
    variance = np.diagonal(covariance)
    square = variance[:, None] + variance[None, :] - 2.0 * covariance
    np.fill_diagonal(square, np.inf)
    std: FloatArray = np.sqrt(square)
    return std
