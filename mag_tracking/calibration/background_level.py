"""Background line and noise of one sensor, as compiled code reads them."""

from collections import deque
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.calibration.blocks import Block, Blocks, line_through, one_is_loud, stacked
from mag_tracking.calibration.resolution import MIN_STD, completed_steps, corrected_steps
from mag_tracking.records import plain

_Line: TypeAlias = tuple[float, FloatArray, FloatArray, float]
"""Centre [s], mean (3,) [T], slope (3,) [T/s] and horizon [s]."""


class BackgroundLevel:
    """Line and noise of the background, kept in the state of its sensor.

    Attributes
    ----------
    line : (float, (3,), (3,), float) or None
        Centre [s], mean [T], slope [T/s] and horizon [s].
    noise : (3, 3) array or None, T^2
        Of one reading, without its steps.
    limits : (3,) array, T
        A block whose mean is further off is not background.
    is_provisional : bool
        Whether the line may be that of something else.
    """

    def __init__(self, sensors: StructArray, freeze_std: float) -> None:
        """`sensors` is (1,) SENSOR; a block is off by more than `freeze_std` deviations."""
        self._sensors, self._freeze_std = sensors, freeze_std
        self._state = sensors[0]
        self.limits = np.full(3, np.nan)
        self.rely()
        self.set(None, None)

    @property
    def is_ready(self) -> bool:
        """Whether both line and noise are known."""
        return self.line is not None and self.noise is not None

    def set(self, line: _Line | None, noise: FloatArray | None) -> None:
        """Line and noise from now on, also those that compiled code reads."""
        s = self._state
        self.line, self.noise = line, noise
        s['is_ready'] = self.is_ready
        if line is not None:
            s['centre'], s['mean'], s['slope'], s['horizon'] = line
        s['noise'] = np.nan if noise is None else noise
        self.apply_steps()

    def apply_steps(self) -> None:
        """Add what the sensor's steps do to the noise; its steps may have been found meanwhile."""
        core.apply_steps(self._sensors, self._freeze_std, self.limits)

    def without_dead_axes(self, noise: FloatArray) -> FloatArray:
        """(3, 3) [T^2] `noise` with NaN for an axis that has not changed and does not rest."""
        steps, variance = corrected_steps(self._sensors), noise.diagonal()
        if np.isfinite(steps).all() and (variance > MIN_STD**2).all():
            return noise
        steps = completed_steps(variance, steps)
        dead = ~np.isfinite(steps) | (steps == 0.0) & (variance <= MIN_STD**2)
        return np.where(dead[:, None] | dead, np.nan, noise)

    def without_unknown_noise(self, covariance: FloatArray) -> FloatArray:
        """(3, 3) [T^2] `covariance` with NaN for an axis that neither changes nor has steps."""
        steps = corrected_steps(self._sensors)
        dead = (covariance.diagonal() <= MIN_STD**2) & ~(np.isfinite(steps) & (steps > 0.0))
        return np.where(dead[:, None] | dead, np.nan, covariance)

    def rely(self, deviation: FloatArray | float = 0.0, is_provisional: bool = False) -> None:
        """The line is the background, with a `deviation` (3,) [T]; NaN = axis not reported."""
        self.is_provisional = is_provisional
        self._state['level_variance'] = np.where(np.isnan(deviation), 0.0, np.square(deviation))

    @property
    def covariance(self) -> FloatArray | None:
        """(3, 3) [T^2] noise of one sample and its steps, or None; NaN for an axis not reported."""
        if self.noise is None:
            return None
        covariance: FloatArray = self.noise + np.diag(self._state['step_variance'])
        return covariance

    @property
    def drift(self) -> FloatArray:
        """(3,) [T/s] of the background; NaN before it is ready, and of an axis not reported."""
        return np.full(3, np.nan) if self.line is None else self.line[2]

    def at(self, time: float) -> FloatArray:
        """(3,) [T] background at `time` [s]; raises ValueError before it is ready."""
        return -self.departure(time, np.zeros(3))

    def rest_at(self, blocks: Blocks) -> None:
        """From now on the level is that of `blocks`, without a drift."""
        self.set((0.0, line_through(blocks)[1], np.zeros(3), 0.0), self.noise)

    def at_all(self, times: FloatArray) -> FloatArray:
        """(k, 3) [T] background at `times` (k,) [s]; raises ValueError before it is ready."""
        if self.line is None:
            raise ValueError('the background has not been learnt yet')
        centre, mean, slope, horizon = self.line
        out: FloatArray = mean + (np.minimum(times, horizon) - centre)[:, None] * slope
        return out

    def departure(self, time: float, field: FloatArray) -> FloatArray:
        """(3,) [T] `field` without the background at `time` [s]."""
        if self.line is None:
            raise ValueError('the background has not been learnt yet')
        out = np.empty(3)
        core.subtract(self._sensors, time, plain(field), out)
        return out

    def steady_end(self, blocks: Sequence[Block], length: float) -> deque[Block] | None:
        """The latest of the blocks, over a `length` [s], if they are of a steady level."""
        since = blocks[-1].time - length
        latest: deque[Block] = deque()
        for block in reversed(blocks):
            if block.time <= since and len(latest) >= 3:
                break
            latest.appendleft(block)
        is_long = len(blocks) >= 3 and blocks[0].time <= since
        return latest if is_long and self.holds(stacked(latest)) else None

    def holds(self, blocks: Blocks) -> bool:
        """Whether blocks are those of a steady level, by the present noise."""
        centre, mean, slope = line_through(blocks)
        off = np.abs(blocks.mean - mean - slope * (blocks.time - centre)[:, None])
        return not one_is_loud(blocks, self._state['step_variance']) \
            and bool(np.nanmax(off / self.limits) <= 1.0)
