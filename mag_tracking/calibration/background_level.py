"""Linear trend and noise of the background of one sensor, in arrays for compiled code."""

from collections import deque
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.calibration.blocks import Block, Blocks, has_noisy_block, line_through, stacked
from mag_tracking.calibration.resolution import MIN_STD, completed_steps, corrected_steps
from mag_tracking.records import plain

_Line: TypeAlias = tuple[float, FloatArray, FloatArray, float]
"""Centre [s], mean (3,) [T], slope (3,) [T/s], and horizon [s], after which the trend is
constant."""


class BackgroundLevel:
    """Linear trend and noise of the background, stored in the state (1,) SENSOR of its sensor.

    Attributes
    ----------
    line : centre [s], mean (3,) [T], slope (3,) [T/s], and horizon [s], after which it is constant
    noise : (3, 3) [T²] covariance of one reading, without the quantisation variance
    limits : (3,) [T] maximum difference of a block mean from the background: `freeze_std` noise std
    is_provisional : whether the trend is preliminary and may differ from the background
    """

    def __init__(self, sensors: StructArray, freeze_std: float) -> None:
        self._sensors, self._freeze_std = sensors, freeze_std
        self._state = sensors[0]
        self.limits = np.full(3, np.nan)
        self.set_uncertainty()
        self.set(None, None)

    @property
    def is_ready(self) -> bool:
        """Whether both the trend and the noise are known."""
        return self.line is not None and self.noise is not None

    def set(self, line: _Line | None, noise: FloatArray | None) -> None:
        """Set trend and noise, and copy them to the sensor state that compiled code reads."""
        s = self._state
        self.line, self.noise = line, noise
        s['is_ready'] = self.is_ready
        if line is not None:
            s['centre'], s['mean'], s['slope'], s['horizon'] = line
        s['noise'] = np.nan if noise is None else noise
        self.apply_steps()

    def apply_steps(self) -> None:
        """Update the quantisation variance of the sensor, its total noise and `limits`."""
        core.apply_steps(self._sensors, self._freeze_std, self.limits)

    def without_dead_axes(self, noise: FloatArray) -> FloatArray:
        """Noise (3, 3) with NaN for dead axes: constant although their steps are not coarse."""
        steps, variance = corrected_steps(self._sensors), noise.diagonal()
        if np.isfinite(steps).all() and (variance > MIN_STD**2).all():
            return noise
        steps = completed_steps(variance, steps)
        is_dead = ~np.isfinite(steps) | (steps == 0.0) & (variance <= MIN_STD**2)
        return np.where(is_dead[:, None] | is_dead, np.nan, noise)

    def without_unknown_noise(self, covariance: FloatArray) -> FloatArray:
        """Covariance with NaN for constant axes whose steps are unknown or too fine to observe."""
        steps = corrected_steps(self._sensors)
        is_unknown = (covariance.diagonal() <= MIN_STD**2) & ~(np.isfinite(steps) & (steps > 0.0))
        return np.where(is_unknown[:, None] | is_unknown, np.nan, covariance)

    def set_uncertainty(self, std: FloatArray | float = 0.0, is_provisional: bool = False) -> None:
        """Set the std of the level, (3,) or scalar T, and whether the trend is preliminary."""
        self.is_provisional = is_provisional
        self._state['level_variance'] = np.where(np.isnan(std), 0.0, np.square(std))

    @property
    def covariance(self) -> FloatArray | None:
        """Noise covariance of one sample, (3, 3) T²; None if unknown, NaN for an unreported axis.

        The quantisation variance of the sensor is included.
        """
        if self.noise is None:
            return None
        covariance: FloatArray = self.noise + np.diag(self._state['step_variance'])
        return covariance

    @property
    def drift(self) -> FloatArray:
        """Drift of the background, (3,) T/s; NaN while unknown and for an unreported axis."""
        return np.full(3, np.nan) if self.line is None else self.line[2]

    def at(self, time: float) -> FloatArray:
        """Background (3,) T at a time in s; raises ValueError if it is not ready."""
        return -self.departure(time, np.zeros(3))

    def set_constant(self, blocks: Blocks) -> None:
        """Set a constant level, the mean of the given blocks."""
        self.set((0.0, line_through(blocks)[1], np.zeros(3), 0.0), self.noise)

    def at_all(self, times: FloatArray) -> FloatArray:
        """Background (k, 3) T at times (k,) in s; raises ValueError if it is not ready."""
        if self.line is None:
            raise ValueError('the background has not been learnt yet')
        centre, mean, slope, horizon = self.line
        out: FloatArray = mean + (np.minimum(times, horizon) - centre)[:, None] * slope
        return out

    def departure(self, time: float, field: FloatArray) -> FloatArray:
        """Field (3,) T minus the background; raises ValueError if the background is not ready."""
        if self.line is None:
            raise ValueError('the background has not been learnt yet')
        out = np.empty(3)
        core.subtract(self._sensors, time, plain(field), out)
        return out

    def steady_end(self, blocks: Sequence[Block], length: float) -> deque[Block] | None:
        """Latest blocks over `length` s; None if not steady, fewer than three, or too short."""
        start = blocks[-1].time - length
        latest_blocks: deque[Block] = deque()
        for block in reversed(blocks):
            if block.time <= start and len(latest_blocks) >= 3:
                break
            latest_blocks.appendleft(block)
        is_long = len(blocks) >= 3 and blocks[0].time <= start
        return latest_blocks if is_long and self.are_steady(stacked(latest_blocks)) else None

    def are_steady(self, blocks: Blocks) -> bool:
        """Whether blocks lie on one line within `limits`, and have similar noise."""
        centre, mean, slope = line_through(blocks)
        residual = np.abs(blocks.mean - mean - slope * (blocks.time - centre)[:, None])
        return not has_noisy_block(blocks, self._state['step_variance']) \
            and bool(np.nanmax(residual / self.limits) <= 1.0)
