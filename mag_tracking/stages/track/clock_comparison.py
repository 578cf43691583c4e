"""Clock offsets between the sensors, estimated from all passes so far."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.stages.track.rigid_pass import MAX_OFFSET, MIN_DISTANCE, RigidPass

SIGNIFICANT_STDS = 4.0
"""An offset is significant only if it exceeds this number of standard deviations."""

MEMORY_PASSES = 20
"""Effective number of passes in the estimate. Older passes lose weight, because clocks drift and
are adjusted."""

FORGETTING_FACTOR, CONTRADICTED_FACTOR = 1.0 - 1.0 / MEMORY_PASSES, 0.5
"""Factor on the previous information at a pass that agrees with the estimate, and at a pass that
contradicts it."""

PRIOR_STD_S = 1e3
"""Prior standard deviation of the offset of each clock [s]."""


@dataclass(frozen=True)
class ClockOffset:
    """Clock with a significant offset."""

    sensor: int
    """Index of the sensor in the network."""
    reference: int | None
    """Index of the reference sensor; None if the clock is compared with all other sensors."""
    offset_s: float
    """Time by which the clock is ahead [s]; negative if it is slow."""
    std_s: float
    """Standard deviation of the offset [s]."""
    n_passes: int
    """Number of passes in which the clock was compared."""

    def text(self, names: Sequence[str]) -> str:
        """Message that states the offset and how to correct the network file."""
        name = names[self.sensor]
        reference = 'the other clocks' if self.reference is None \
            else f'the clock of {names[self.reference]}'
        relation = 'ahead of' if self.offset_s > 0.0 else 'behind'
        correction = 'increase' if self.offset_s > 0.0 else 'decrease'
        passes = f'{self.n_passes} passes' if self.n_passes > 1 else 'one pass'
        return (f'the clock of {name} is {1e3 * abs(self.offset_s):.0f} ms {relation} {reference} '
                f'(standard deviation {1e3 * self.std_s:.0f} ms, from {passes}), or a sensor '
                'position in the network file is wrong. Tracks are ambiguous until this is fixed: '
                f'{correction} clock_offset of {name} by {abs(self.offset_s):.3f} s')


class ClockComparison:
    """Clock offsets estimated from several passes by recursive least squares.

    A wrong sensor position has the same effect as a wrong clock if all vehicles pass in the same
    direction at the same speed.
    """

    def __init__(self, n_sensors: int) -> None:
        # Information matrix of the clock offsets, and its product with their estimates.
        self._information = np.zeros((n_sensors, n_sensors))
        self._vector = np.zeros(n_sensors)
        self._n_passes = np.zeros(n_sensors, dtype=np.int64)
        # Weighted number of passes, and weighted sum of their inverse speeds.
        self._weight, self._slowness = 0.0, 0.0
        # [s] Significant offsets between the clocks, else 0; computed once per pass.
        self._offset_s: FloatArray = np.zeros((n_sensors, n_sensors))

    def largest_offset_s(self, rows: IntArray) -> float:
        """Largest significant offset between the clocks of two of the sensors `rows` of the
        network; 0 if none is significant.

        Clocks that were compared in only one pass are ignored, because this pass may contain two
        vehicles.
        """
        repeated = rows[self._n_passes[rows] > 1]
        return float(self._offset_s[np.ix_(repeated, repeated)].max(initial=0.0))

    @property
    def largest_offset(self) -> ClockOffset | None:
        """Largest significant offset, attributed to a clock; None if no offset is significant."""
        ahead, behind = map(int, np.unravel_index(np.argmax(self._offset_s), self._offset_s.shape))
        if self._offset_s[ahead, behind] == 0.0:
            return None
        offset, std = self._offsets()
        compared = np.flatnonzero(self._n_passes)
        if len(compared) == 2:
            return ClockOffset(ahead, behind, float(offset[ahead, behind]),
                               float(std[ahead, behind]), int(self._n_passes[compared].min()))
        # With more than two clocks, the wrong clock disagrees with most other clocks.
        median = np.median(offset[np.ix_(compared, compared)], axis=1)
        k = int(np.argmax(np.abs(median)))
        j = int(compared[k])
        behind_k = behind if j == ahead else ahead
        return ClockOffset(j, None, float(median[k]), float(std[j, behind_k]),
                           int(self._n_passes[j]))

    def add(self, rigid_pass: RigidPass, rows: IntArray) -> None:
        """Add a pass with the sensors `rows` of the network to the estimate.

        A pass is ignored if no straight path explains it, if a bent path explains it significantly
        better, or if the vehicle is so slow that the fit hardly depends on the clocks.
        """
        is_slow = rigid_pass.speed * MAX_OFFSET < MIN_DISTANCE
        if is_slow or not (rigid_pass.is_explained and rigid_pass.is_straight):
            return
        is_known = np.abs(rigid_pass.offset) <= MAX_OFFSET
        is_known[rigid_pass.reference] = False
        factor = CONTRADICTED_FACTOR if self._contradicts(rigid_pass, rows, is_known) \
            else FORGETTING_FACTOR
        self._information *= factor
        self._vector *= factor
        for j in np.flatnonzero(is_known):
            direction = np.zeros(len(self._vector))
            direction[rows[j]], direction[rows[rigid_pass.reference]] = 1.0, -1.0
            self._information += np.outer(direction, direction) / rigid_pass.clock_variance(j)
            self._vector += direction * rigid_pass.offset[j] / rigid_pass.clock_variance(j)
        if is_known.any():
            self._n_passes[rows[is_known]] += 1
            self._n_passes[rows[rigid_pass.reference]] += 1
        self._weight = 1.0 + factor * self._weight
        self._slowness = 1.0 / rigid_pass.speed + factor * self._slowness
        offset, std = self._offsets()
        # An offset is harmless if a vehicle of average speed travels less than `MIN_DISTANCE` in
        # this time.
        min_offset = MIN_DISTANCE * self._slowness / self._weight
        self._offset_s = np.where(
            (offset > SIGNIFICANT_STDS * std) & (offset > min_offset), offset, 0.0)

    def _contradicts(self, rigid_pass: RigidPass, rows: IntArray, is_known: BoolArray) -> bool:
        """Whether a pass contradicts the previous estimate for any clock in the mask `is_known`."""
        offset, std = self._offsets()
        reference = rows[rigid_pass.reference]
        return any(
            abs(rigid_pass.offset[j] - offset[rows[j], reference]) > SIGNIFICANT_STDS * np.sqrt(
                rigid_pass.clock_variance(j) + std[rows[j], reference]**2)
            for j in np.flatnonzero(is_known))

    def _offsets(self) -> tuple[FloatArray, FloatArray]:
        """Time by which the clock of each row is ahead of the clock of each column, and its std,
        infinite on the diagonal, both (n, n) [s]."""
        # The common offset of all clocks is not observable; the prior fixes it.
        prior = np.eye(len(self._vector)) / PRIOR_STD_S**2
        covariance: FloatArray = np.linalg.inv(self._information + prior).astype(np.float64)
        offset = covariance @ self._vector
        variance = np.diagonal(covariance)
        variance_of_difference = variance[:, None] + variance[None, :] - 2.0 * covariance
        np.fill_diagonal(variance_of_difference, np.inf)
        return offset[:, None] - offset[None, :], np.sqrt(variance_of_difference)

