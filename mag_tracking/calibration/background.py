"""Background field and noise of one sensor, learnt from target-free stretches.

The background is a straight line in time (level and drift) through the means
of short quiet blocks; the noise is their pooled scatter. A block that departs
from the line freezes the learning, and takes with it what was learnt shortly
before: a target comes near gradually. Source: TSP14 section VI, T10 section
6.3 (mean and covariance of a target-free stretch); the line and the freezing
are this package's own.
"""

from collections import deque
from math import inf
from typing import TypeAlias

import numpy as np
from numba import float64, int64, njit, void

from mag_tracking.arrays import FloatArray, Record, StructArray
from mag_tracking.calibration.blocks import (
    Block,
    Blocks,
    BlockWindow,
    block_of,
    line_through,
    stacked,
)
from mag_tracking.calibration.resolution import (
    LEAST_STD,
    apply_steps,
    completed_steps,
    corrected_steps,
)
from mag_tracking.calibration.sensor_state import SENSORS

LOUDEST = 100.0
"""A block whose variance is so many times that of the quietest is no noise: a target passed within
it, as it can within the long blocks of a slow sensor. Noise and coarse steps stay well below."""

RESUMED_RELEARN_S = 10.0
"""[s] What was resumed gives way to another steady level after so long, whatever `relearn` is."""

_Line: TypeAlias = tuple[float, FloatArray, FloatArray, float]
"""Centre [s], mean (3,) [T], slope (3,) [T/s] and horizon [s]."""


@njit(cache=True, inline='always')
def subtract_background(s: Record, time: float, field: FloatArray, out: FloatArray) -> None:
    """Field without the background at `time` [s]: from `field` (3,) [T] into `out` (3,).

    The drift is extrapolated over at most twice the stretch that it was fitted to: a drift
    learnt from three seconds does not hold for twenty.
    """
    since = min(time, s.horizon) - s.centre
    for a in range(3):
        out[a] = field[a] - s.mean[a] - since * s.slope[a]


@njit(void(SENSORS, int64, float64, float64[::1], float64[::1]), cache=True)
def _subtract(sensors: StructArray, j: int, time: float, field: FloatArray,
              out: FloatArray) -> None:
    """`subtract_background` of sensor `j`."""
    subtract_background(sensors[j], time, field, out)


class RunningBackground:
    """Running estimate of one sensor's background; times in seconds of the records.

    Parameters
    ----------
    learn, memory, guard, block : float [s]
        Quiet time needed before it is ready; length of the stretch that the
        line is fitted to; how far the line stays behind the present; length
        of a block.
    freeze_std : float
        A block departs if its mean is this many noise deviations off.
    relearn : float [s]
        After so long frozen on a steady level that level is the new
        background; 0 = never.
    background, noise_std : (3,) [T], optional
        Known beforehand: with both it is ready at once.
    phase : float, optional
        Staggers the blocks of many sensors that began together: the first block is longer by
        this share, and the others follow at even times. A complete block is judged by
        `judge_block`, or before the next reading. Without a phase it is judged at once.
    sensors : (1,) SENSOR
        State of the sensor: holds the present block, and line and noise for compiled code.
    """

    def __init__(self, learn: float, memory: float, guard: float, block: float,
                 freeze_std: float, relearn: float, background: FloatArray | None = None,
                 noise_std: FloatArray | None = None, phase: float | None = None, *,
                 sensors: StructArray) -> None:
        self._learn, self._guard, self._length = learn, guard, block
        self._freeze_std, self._relearn = freeze_std, relearn
        self._sensors = sensors
        self._limits = np.full(3, np.nan)
        self._state = self._sensors[0]
        self._state['length'], self._state['phase'] = block, np.nan if phase is None else phase
        self._most = max(3, int(round(memory / block)))
        self._window = BlockWindow(self._most)
        self._given = None if background is None else np.asarray(background, dtype=float)
        self._noise: FloatArray | None = \
            None if noise_std is None else np.diag(np.asarray(noise_std, float) ** 2)
        self._noise_given = self._noise is not None
        self.n_relearnt = 0
        self.forget()

    def forget(self) -> None:
        """Drop what was learnt; what was given beforehand stays."""
        self._state['n'], self._state['end'], self._state['is_full'] = 0, np.nan, False
        self._window.clear()
        self._pending: deque[Block] = deque()
        self._strange: deque[Block] = deque()
        self._rested: deque[Block] = deque(maxlen=self._most)
        self.frozen = self._resumed = self._relearns_soon = False
        self._set(None if self._given is None else (0.0, self._given, np.zeros(3), 0.0),
                  self._noise if self._noise_given else None)
        self.stuck = False

    def _set(self, line: _Line | None, noise: FloatArray | None) -> None:
        """Line and noise from now on, also those that compiled code reads."""
        s = self._state
        self._line, self._noise = line, noise
        s['is_ready'] = self.ready
        if line is not None:
            s['centre'], s['mean'], s['slope'], s['horizon'] = line
        s['noise'] = np.nan if noise is None else noise
        self._apply_steps()

    def _apply_steps(self) -> None:
        """Add what the sensor's steps do to the noise; its steps may have been found meanwhile."""
        apply_steps(self._sensors, self._freeze_std, self._limits)

    def _without_dead_axes(self, noise: FloatArray) -> FloatArray:
        """(3, 3) [T^2] `noise` with NaN for an axis that has not changed and does not rest."""
        steps, variance = corrected_steps(self._sensors), noise.diagonal()
        if np.isfinite(steps).all() and (variance > LEAST_STD**2).all():
            return noise
        steps = completed_steps(variance, steps)
        dead = ~np.isfinite(steps) | (steps == 0.0) & (variance <= LEAST_STD**2)
        return np.where(dead[:, None] | dead, np.nan, noise)

    def resume(self, background: FloatArray, covariance: FloatArray) -> None:
        """Go on from what was known a moment ago: (3,) [T] and (3, 3) [T^2], NaN as elsewhere.

        It is a line again when a stretch as long as at first has been quiet.
        """
        self._set((0.0, np.asarray(background, dtype=float), np.zeros(3), 0.0),
                  self._noise if self._noise_given else np.asarray(covariance, dtype=float))
        self._resumed = self._relearns_soon = True

    def begin_with(self, level: FloatArray, covariance: FloatArray) -> None:
        """Begin with a level that later readings have: (3,) [T] and (3, 3) [T^2].

        As after `resume`, but another level has to last as long as it always has to. Nothing is
        begun where no axis changes.
        """
        steps = corrected_steps(self._sensors)
        dead = (covariance.diagonal() <= LEAST_STD**2) & ~(np.isfinite(steps) & (steps > 0.0))
        covariance = np.where(dead[:, None] | dead, np.nan, covariance)
        if np.isnan(covariance).all():
            return
        self.resume(level, covariance)
        self._relearns_soon = False

    @property
    def ready(self) -> bool:
        """Whether both background and noise are known."""
        return self._line is not None and self._noise is not None

    @property
    def covariance(self) -> FloatArray | None:
        """(3, 3) [T^2] noise of one sample and its steps, or None; NaN for an axis not reported."""
        if self._noise is None:
            return None
        covariance: FloatArray = self._noise + np.diag(self._state['step_variance'])
        return covariance

    @property
    def scatter_std(self) -> FloatArray:
        """(3,) [T] scatter of the quiet readings and their steps, whatever noise was given; NaN =
        unknown.
        """
        found = pooled_covariance(self._window.blocks()) if self._window else None
        if found is None:
            return np.full(3, np.nan)
        variance = found.diagonal() + self._state['step_variance']
        return np.where(variance > 0.0, np.sqrt(variance), np.nan)

    @property
    def measured(self) -> bool:
        """Whether the background is from readings, not from what was given beforehand."""
        return bool(self._window) and self.ready

    @property
    def drift(self) -> FloatArray:
        """(3,) [T/s] of the background; NaN before it is ready, and of an axis not reported."""
        return np.full(3, np.nan) if self._line is None else self._line[2]

    def level(self, time: float) -> FloatArray:
        """(3,) [T] background at `time` [s]; raises ValueError before it is ready."""
        return -self._departure(time, np.zeros(3))

    def _departure(self, time: float, field: FloatArray) -> FloatArray:
        """(3,) [T] `field` without the background at `time` [s]."""
        if self._line is None:
            raise ValueError('the background has not been learnt yet')
        out = np.empty(3)
        _subtract(self._sensors, 0, time, field, out)
        return out

    def judge_block(self) -> None:
        """Judge the block that the latest sample has shown to be complete."""
        if not self._state['is_full']:
            return
        block = block_of(self._state)
        self._state['is_full'] = False
        still = (block.n > 1) & (block.scatter.diagonal() < LEAST_STD**2 * (block.n - 1))
        if self.ready:
            self._apply_steps()
            # An axis with coarse steps rests; one with fine steps is stuck.
            self.stuck = bool((still & (self._state['step_variance'] == 0.0)
                               & ~np.isnan(self._state['noise_std'])).any())
            if not self.stuck:
                self._follow(block)
        else:
            self.stuck = bool(still[block.n > 1].all())
            self._begin(block)

    def _begin(self, block: Block) -> None:
        """Before it is ready: collect until a quiet stretch is long enough."""
        self._strange.append(block)
        if self.stuck:
            # Without a change nothing is known of the steps. The first one comes with a target.
            self._rested.append(block)
        elif self._rested and self._rested[-1].time - self._rested[0].time \
                >= self._learn - 1.5 * self._length and self._adopt_if_steady(self._rested):
            return
        # From centre to centre; the blocks of a slow sensor may be longer than `_length`.
        enough = self._learn - 1.5 * self._length
        while len(self._strange) > 3 and block.time - self._strange[1].time >= enough:
            self._strange.popleft()
        if len(self._strange) >= 3 and block.time - self._strange[0].time >= enough:
            self._adopt_if_steady(self._strange)

    def _follow(self, block: Block) -> None:
        """Once ready: extend the quiet stretch, or freeze."""
        off = np.abs(self._departure(block.time, block.mean))
        # A comparison with NaN is false: an axis that is not reported freezes nothing.
        self.frozen = bool((off > self._limits).any())
        if self.frozen:
            self._pending.clear()
            self._strange.append(block)
            relearn = self._relearn
            if self._resumed and self._relearns_soon:
                # It may be that the sensor was moved, or its surroundings changed, meanwhile.
                relearn = min(relearn or inf, max(self._learn, RESUMED_RELEARN_S))
            if relearn and block.time - self._strange[0].time >= relearn:
                if self._adopt_if_steady(self._strange):
                    self.n_relearnt += 1
                    self.frozen = False
                else:
                    self._strange.popleft()
            elif not relearn:
                self._strange.clear()
            return
        self._strange.clear()
        self._pending.append(block)
        while self._pending and self._pending[0].time <= block.time - self._guard:
            self._window.append(self._pending.popleft())
            self._fit()

    def _adopt_if_steady(self, collected: deque[Block]) -> bool:
        """Take the collected blocks as the background if they lie on one line."""
        blocks = stacked(collected)
        noise = self._noise if self._noise_given else pooled_covariance(blocks)
        if noise is None:
            return False
        noise = self._without_dead_axes(noise)
        if np.isnan(noise).all():
            return False
        before = self._noise
        self._set(self._line, noise)
        centre, mean, slope = line_through(blocks)
        off = np.abs(blocks.mean - mean - slope * (blocks.time - centre)[:, None])
        if _one_is_loud(blocks, self._state['step_variance']) \
                or not np.nanmax(off / self._limits) <= 1.0:
            self._set(self._line, before)
            return False
        if self._given is not None and self._line is not None and not self.n_relearnt \
                and not self.frozen:
            # The background was given and only the noise had to be learnt.
            self._strange.clear()
            return True
        # A steady stretch was asked for its own length; it need not be as long as at first.
        self._resumed = False
        self._window.clear()
        for block in list(collected)[-self._most:]:
            self._window.append(block)
        self._strange.clear()
        self._rested.clear()
        self._fit()
        return True

    def _fit(self) -> None:
        """Line and noise from the present window."""
        blocks = self._window.blocks()
        first, last = float(blocks.time.min()), float(blocks.time.max())
        if (self._given is not None or self._resumed) and last - first < self._learn:
            return
        self._resumed = False
        centre, mean, slope = line_through(blocks)
        noise = None if self._noise_given else pooled_covariance(blocks)
        self._set((centre, mean, slope, last + 2.0 * (last - first)),
                  self._noise if noise is None else self._without_dead_axes(noise))


def _one_is_loud(blocks: Blocks, step_variance: FloatArray) -> bool:
    """Whether a block scatters far more than the others, on any axis.

    `step_variance` (3,) [T^2] is what the sensor's steps add.
    """
    n = blocks.n
    variance = np.where(n > 1, np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1, 1), np.nan)
    variance = np.maximum(variance, step_variance)
    known = variance[:, ~np.isnan(variance).all(axis=0)]
    return bool((np.nanmax(known, axis=0) > LOUDEST * np.nanmin(known, axis=0)).any())


def pooled_covariance(blocks: Blocks) -> FloatArray | None:
    """(3, 3) scatter within blocks, pooled; None = too few samples, NaN = axis not reported."""
    freedom = blocks.n.sum(axis=0) - np.count_nonzero(blocks.n, axis=0)
    if freedom.max() <= 3:
        return None
    freedom = np.where(freedom > 3, freedom, np.nan)
    covariance: FloatArray = \
        blocks.scatter.sum(axis=0) / np.sqrt(freedom[:, None] * freedom[None, :])
    return covariance
