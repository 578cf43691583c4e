"""Fits of the whole passes of a running track, and the clock offsets that several passes show."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import doubts, pass_samples
from mag_tracking.stages.track.disturbances import field_magnitudes
from mag_tracking.stages.track.plausibility import moves_too_far
from mag_tracking.stages.track.smoothing import TrackState
from mag_tracking.units import NS

SIGNIFICANT_STDS, PRIOR_STD_S = 4.0, 1e3
"""Significance of an offset [standard deviations], and prior std of each clock [s]."""
MEMORY_PASSES = 20
"""Effective number of passes in the estimate; clocks drift and are adjusted."""
FORGETTING_FACTOR, CONTRADICTED_FACTOR = 1.0 - 1.0 / MEMORY_PASSES, 0.5
"""Factors on earlier information at a pass that agrees, and at one that contradicts."""
PASSED_FRACTION = 0.6
"""A vehicle has passed when the field is below this fraction of its maximum."""
FIRST_CHECK_S, CHECK_INTERVAL_RATIO = 0.12, 1.7
"""[s] Delay of the first fit after the maximum of the field, and ratio of successive delays."""
BEFORE_S, AFTER_S = 4.0, 3.0
"""[s] Duration of a pass before and after the maximum of the field."""
MIN_FRAMES, MAX_FRAMES = 12, 128
"""Minimum and maximum number of frames in a fit. A longer pass is decimated."""
STEADY_S, LATE_MISFIT = 1.5, 8.0
"""[s] Time after the maximum with constant acceleration and turn rate; maximum later misfit."""


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

    If all vehicles pass alike, a wrong sensor position has the same effect as a wrong clock.
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
        network; 0 if none is significant."""
        # Clocks that were compared in only one pass are ignored: it may contain two vehicles.
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

    def add(self, rigid_pass: pass_samples.RigidPass, rows: IntArray) -> None:
        """Add a pass with the sensors `rows` of the network, unless no straight path explains it, a
        bent one is significantly better, or the vehicle is slow."""
        is_slow = rigid_pass.speed * pass_samples.MAX_OFFSET < pass_samples.MIN_DISTANCE
        if is_slow or not (rigid_pass.is_explained and rigid_pass.is_straight):
            return
        is_known = np.abs(rigid_pass.offset) <= pass_samples.MAX_OFFSET
        is_known[rigid_pass.reference] = False
        compared, reference = np.flatnonzero(is_known), rows[rigid_pass.reference]
        offset, std = self._offsets()
        contradicts = any(abs(rigid_pass.offset[j] - offset[rows[j], reference])
                          > SIGNIFICANT_STDS * np.sqrt(rigid_pass.clock_variance(j)
                                                       + std[rows[j], reference]**2)
                          for j in compared)
        factor = CONTRADICTED_FACTOR if contradicts else FORGETTING_FACTOR
        self._information *= factor
        self._vector *= factor
        for j in compared:
            direction = np.zeros(len(self._vector))
            direction[rows[j]], direction[reference] = 1.0, -1.0
            self._information += np.outer(direction, direction) / rigid_pass.clock_variance(j)
            self._vector += direction * rigid_pass.offset[j] / rigid_pass.clock_variance(j)
        if len(compared):
            self._n_passes[[*rows[compared], reference]] += 1
        self._weight = 1.0 + factor * self._weight
        self._slowness = 1.0 / rigid_pass.speed + factor * self._slowness
        offset, std = self._offsets()
        # An offset is harmless if a vehicle of average speed travels less than `MIN_DISTANCE` in
        # this time.
        min_offset = pass_samples.MIN_DISTANCE * self._slowness / self._weight
        self._offset_s = np.where(
            (offset > SIGNIFICANT_STDS * std) & (offset > min_offset), offset, 0.0)

    def _offsets(self) -> tuple[FloatArray, FloatArray]:
        """Differences (n, n) [s] of row clocks from column clocks, and their stds."""
        # The common offset of all clocks is not observable; the prior fixes it.
        prior = np.eye(len(self._vector)) / PRIOR_STD_S**2
        covariance: FloatArray = np.linalg.inv(self._information + prior).astype(np.float64)
        offset = covariance @ self._vector
        variance = np.diagonal(covariance)
        variance_of_difference = variance[:, None] + variance[None, :] - 2.0 * covariance
        np.fill_diagonal(variance_of_difference, np.inf)
        return offset[:, None] - offset[None, :], np.sqrt(variance_of_difference)


class _FrameSummary(NamedTuple):
    """Time [ns], largest field [T] of any sensor, and position and velocity (6,) of a frame."""

    stamp_ns: int
    magnitude: float
    state: FloatArray


class CrossCheck:
    """Cross-check of a track against fits of a steady path to all frames of the pass; `difference`
    (6,) is `RigidPass.difference` of the latest state [m, m/s], first zero."""

    def __init__(self, network: SensorNetwork) -> None:
        self.latest: pass_samples.RigidPass | None = None
        self._network = network
        self._frames: list[FieldFrame] = []
        self._peak: _FrameSummary | None = None
        self._current: _FrameSummary | None = None
        self._period_s = np.inf
        self._due_s = FIRST_CHECK_S
        self._is_misfit = False
        self._min_magnitude = np.inf
        self._has_risen, self._is_whole_pass = False, False
        self.difference: FloatArray = np.zeros(6)

    def add(self, frame: FieldFrame, state: FloatArray) -> None:
        """Add a frame of the track, with the state (n_x,) of the best hypothesis."""
        magnitude = float(field_magnitudes(frame).max(initial=0.0))
        if self._current is not None:
            # The minimum interval is not affected by gaps.
            self._period_s = min(self._period_s, (frame.stamp_ns - self._current.stamp_ns) / NS)
        self._current = _FrameSummary(frame.stamp_ns, magnitude, state[:6].copy())
        if self._peak is None or magnitude > self._peak.magnitude:
            self._peak, self._due_s = self._current, FIRST_CHECK_S
            self._has_risen = self._min_magnitude <= PASSED_FRACTION * magnitude
        self._min_magnitude = min(self._min_magnitude, magnitude)
        # Drop frames that belong neither to this pass nor to a later one.
        earliest, peak_ns = frame.stamp_ns - BEFORE_S * NS, self._peak.stamp_ns
        self._frames = [f for f in self._frames if f.stamp_ns >= earliest
                        or _is_in_pass(f.stamp_ns, peak_ns)]
        self._frames.append(frame)

    def doubts(self, clocks_apart_s: float) -> set[str]:
        """Fit the pass if due, and return the doubts; `clocks_apart_s` is from earlier passes."""
        if self._current is None:
            return set()
        self._fit_if_due(self._current.magnitude)
        if self.latest is not None and self._covers(self._current.stamp_ns):
            self.difference = self.latest.difference(self._current.stamp_ns, self._current.state)
        reasons = self._pass_doubts()
        if clocks_apart_s * float(np.hypot(*self._current.state[3:5])) > pass_samples.MIN_DISTANCE:
            reasons.add(doubts.CLOCKS_APART)
        return reasons

    def differences(self, states: Sequence[TrackState]) -> list[FloatArray]:
        """`RigidPass.difference` (6,) of each smoothed state, in chronological order, m and m/s;
        before and after the pass that of its first and last state, `difference` without any."""
        covered = [k for k, (stamp_ns, _, _) in enumerate(states) if self._covers(stamp_ns)]
        if self.latest is None or not covered:
            return [self.difference] * len(states)
        first, last = covered[0], covered[-1]
        in_pass = [self.latest.difference(stamp_ns, x[:6])
                   for stamp_ns, x, _ in states[first:last + 1]]
        return [in_pass[min(max(k, first), last) - first] for k in range(len(states))]

    def _covers(self, stamp_ns: int) -> bool:
        """Whether the latest fit determines the position at a time, from a whole pass."""
        return self.latest is not None and self._is_whole_pass \
            and _is_in_pass(stamp_ns, self.latest.stamp_ns)

    @property
    def is_doubtful(self) -> bool:
        """Whether the latest fit raises any doubt about the track."""
        return bool(self._pass_doubts())

    def finish(self, clocks: ClockComparison, rows: IntArray) -> None:
        """Fit the pass at the end if due; add it to the comparison with sensors `rows`."""
        self._fit_if_due(0.0)
        if self.latest is not None:
            clocks.add(self.latest, rows)

    def _fit_if_due(self, magnitude: float) -> None:
        """Fit the pass if a fit is due; `magnitude` [T] is the largest current field."""
        current, peak = self._current, self._peak
        if current is None or peak is None or self._due_s > AFTER_S \
                or magnitude > PASSED_FRACTION * peak.magnitude:
            return
        elapsed_s = (current.stamp_ns - peak.stamp_ns) / NS
        frames = [f for f in self._frames if _is_in_pass(f.stamp_ns, peak.stamp_ns)]
        if elapsed_s < self._due_s or len(frames) < MIN_FRAMES:
            return
        self._due_s = CHECK_INTERVAL_RATIO * elapsed_s
        # Start values: the current state extrapolated back, and the state at the maximum of the
        # field.
        extrapolated = current.state.copy()
        extrapolated[:3] -= elapsed_s * extrapolated[3:]
        step = -(-len(frames) // MAX_FRAMES)
        rigid_pass = pass_samples.fit_rigid_pass(
            self._network, frames[::step], peak.stamp_ns, np.array([extrapolated, peak.state]))
        if rigid_pass is None:
            return
        self.latest, self._is_whole_pass = rigid_pass, self._has_risen
        if elapsed_s <= STEADY_S:
            self._is_misfit = rigid_pass.misfit > pass_samples.MAX_MISFIT

    def _pass_doubts(self) -> set[str]:
        """Doubts about the track that follow from the latest fit."""
        latest = self.latest
        if latest is None:
            return set()
        return doubts.applying({
            # The middle of a long vehicle is uncertain by up to its length.
            doubts.ANOTHER_PLACE: np.hypot(*self.difference[:2]) > pass_samples.LONG_LENGTH,
            doubts.NO_STEADY_PATH: self._is_misfit or latest.misfit > LATE_MISFIT,
            doubts.CLOCKS_APART: latest.needs_clock_offsets,
            doubts.FRAMES_TOO_LONG: latest.is_explained and moves_too_far(
                latest.closest(self._network.positions), latest.velocity, self._period_s,
                self._network.positions)})


def _is_in_pass(stamp_ns: int, peak_ns: int) -> bool:
    """Whether a time belongs to the pass with the maximum of the field at `peak_ns`."""
    return -BEFORE_S * NS <= stamp_ns - peak_ns <= AFTER_S * NS
