"""How far the clocks of the sensors are apart, by all the passes so far."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.stages.track.rigid_pass import MAX_OFFSET, MIN_DISTANCE, RigidPass

SIGNIFICANT_STD = 4.0
"""Standard deviations at which clocks are called apart."""

MEMORY_PASSES = 20
"""About so many passes count: clocks are set, and drift."""

FORGETTING_FACTOR, CONTRADICTED_FACTOR = 1.0 - 1.0 / MEMORY_PASSES, 0.5
"""Share of the evidence that is kept with each pass, and with one that contradicts it."""

PRIOR_STD_S = 1e3
"""[s] Deviation of a clock that nothing is known of."""


@dataclass(frozen=True)
class ClockOffset:
    """The clock that is off."""

    sensor: int
    """Its row."""
    against: int | None
    """Row of the sensor that it is compared to; None = the others."""
    offset_s: float
    """How far it is ahead; negative = behind."""
    std_s: float
    n_passes: int
    """Number of passes that compared it."""

    def text(self, names: Sequence[str]) -> str:
        """A sentence about it; `names` are those of the sensors."""
        name = names[self.sensor]
        others = 'those of the others' if self.against is None else f'that of {names[self.against]}'
        where = 'ahead of' if self.offset_s > 0.0 else 'behind'
        more = 'more' if self.offset_s > 0.0 else 'less'
        passes = f'{self.n_passes} passes' if self.n_passes > 1 else 'one pass'
        return (f'the clock of {name} seems {1e3 * abs(self.offset_s):.0f} ms {where} {others} '
                f'(standard deviation {1e3 * self.std_s:.0f} ms, by {passes}), or a sensor is not '
                'where the network file says; tracks are ambiguous until that is put right '
                f'(clock_offset of {name}: {abs(self.offset_s):.3f} {more})')


class ClockComparison:
    """The offsets of several passes, folded into one answer.

    A sensor that is not where the network file says looks like one with a wrong clock as long as
    all vehicles go the same way at the same speed.
    """

    def __init__(self, n_sensors: int) -> None:
        # Information on the clocks' offsets, and its product with them.
        self._information = np.zeros((n_sensors, n_sensors))
        self._vector = np.zeros(n_sensors)
        self._n_passes = np.zeros(n_sensors, dtype=np.int64)
        # Passes that count, and the sum of one over their speeds.
        self._weight, self._slowness = 0.0, 0.0
        # [s] Differences of the clocks that are apart for sure, else 0; all at once, with a pass.
        self._apart: FloatArray = np.zeros((n_sensors, n_sensors))

    def apart_s(self, rows: IntArray) -> float:
        """[s] How far two clocks of the sensors `rows` are apart.

        Clocks that a single pass compared do not count: it may have been of two vehicles.
        """
        repeated = rows[self._n_passes[rows] > 1]
        return float(self._apart[np.ix_(repeated, repeated)].max(initial=0.0))

    @property
    def apart(self) -> ClockOffset | None:
        """The clock that is off, where one is for sure."""
        ahead, behind = map(int, np.unravel_index(np.argmax(self._apart), self._apart.shape))
        if self._apart[ahead, behind] == 0.0:
            return None
        offset, std = self._differences()
        compared = np.flatnonzero(self._n_passes)
        if len(compared) == 2:
            return ClockOffset(ahead, behind, float(offset[ahead, behind]),
                               float(std[ahead, behind]), int(self._n_passes[compared].min()))
        # Of several clocks the one that most others disagree with is off.
        middle = np.median(offset[np.ix_(compared, compared)], axis=1)
        k = int(np.argmax(np.abs(middle)))
        j = int(compared[k])
        other = behind if j == ahead else ahead
        return ClockOffset(j, None, float(middle[k]), float(std[j, other]), int(self._n_passes[j]))

    def add(self, found: RigidPass, rows: IntArray) -> None:
        """Count a pass of the sensors `rows`.

        One that no straight path explains says nothing, nor one that is too slow to depend on
        clocks.
        """
        is_slow = found.speed * MAX_OFFSET < MIN_DISTANCE
        if is_slow or not (found.is_explained and found.is_straight):
            return
        known = np.abs(found.offset) <= MAX_OFFSET
        known[found.reference] = False
        kept = CONTRADICTED_FACTOR if self._contradicts(found, rows, known) else FORGETTING_FACTOR
        self._information *= kept
        self._vector *= kept
        for j in np.flatnonzero(known):
            direction = np.zeros(len(self._vector))
            direction[rows[j]], direction[rows[found.reference]] = 1.0, -1.0
            self._information += np.outer(direction, direction) / found.clock_variance(j)
            self._vector += direction * found.offset[j] / found.clock_variance(j)
        if known.any():
            self._n_passes[rows[known]] += 1
            self._n_passes[rows[found.reference]] += 1
        self._weight = 1.0 + kept * self._weight
        self._slowness = 1.0 / found.speed + kept * self._slowness
        offset, std = self._differences()
        # An offset in which vehicles, as fast as those so far, go less than a metre does no harm.
        least = MIN_DISTANCE * self._slowness / self._weight
        self._apart = np.where((offset > SIGNIFICANT_STD * std) & (offset > least), offset, 0.0)

    def _contradicts(self, found: RigidPass, rows: IntArray, known: BoolArray) -> bool:
        """Whether a pass says otherwise than those before it, of one of the clocks `known`."""
        offset, std = self._differences()
        reference = rows[found.reference]
        return any(abs(found.offset[j] - offset[rows[j], reference]) > SIGNIFICANT_STD * np.sqrt(
            found.clock_variance(j) + std[rows[j], reference]**2) for j in np.flatnonzero(known))

    def _differences(self) -> tuple[FloatArray, FloatArray]:
        """(n, n) [s]: how far each clock (row) is ahead of each (column), and the deviation."""
        # What all clocks have in common is arbitrary.
        loose = np.eye(len(self._vector)) / PRIOR_STD_S**2
        covariance: FloatArray = np.linalg.inv(self._information + loose).astype(np.float64)
        offset = covariance @ self._vector
        variance = np.diagonal(covariance)
        square = variance[:, None] + variance[None, :] - 2.0 * covariance
        np.fill_diagonal(square, np.inf)
        return offset[:, None] - offset[None, :], np.sqrt(square)

