"""Levels of one sensor: its background with trend and noise, the former one, departures from it."""

from collections import deque
from collections.abc import Iterable, Sequence
from math import inf
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.calibration.blocks import Block, Blocks, has_noisy_block, line_through, stacked
from mag_tracking.calibration.frequent_level import MIN_DURATION_RATIO
from mag_tracking.calibration.level_change import NO_CHANGE, ChangeEvaluator, level_change
from mag_tracking.calibration.sensor_state import completed_steps, corrected_steps
from mag_tracking.records import plain
from mag_tracking.units import NS

TYPICAL_DRIFT, STEEP_DRIFT = 3e-9, 1e-8
"""[T/s] Typical and maximum drift of a background; the latter while a sensor is warming up."""
MIN_SLOPE_STDS = 4.0
"""Number of standard deviations by which a slope must exceed `STEEP_DRIFT`."""
MAX_AGE_S, MAX_DRIFT = 600.0, 4.0
"""Maximum age [s] of a former level, and its maximum drift in tolerances of a block mean."""
MIN_RELEARN_S = 10.0
"""[s] Minimum duration of another steady level that replaces a resumed or short background."""
SHORTENED_FRACTION = 2.0 / 3.0
"""Required duration of a former level, or of that after a departure, relative to the usual one."""
MAX_EVALUATED_BLOCKS = 240
"""Maximum number of blocks (a minute of the usual length) of an evaluated arrival or departure."""
Line: TypeAlias = tuple[float, FloatArray, FloatArray, float]
"""Centre [s], mean (3,) [T], slope (3,) [T/s], and horizon [s], after which it is constant."""


class BackgroundLevel:
    """Linear trend and noise of the background, stored in the state (1,) SENSOR of its sensor.

    Attributes
    ----------
    line : trend of the background; None if unknown
    noise : (3, 3) [T²] covariance of one reading, without the quantisation variance
    limits : (3,) [T] maximum difference of a block mean from the background: `freeze_std` noise std
    is_provisional : whether the trend is preliminary and may differ from the background
    """

    def __init__(self, sensors: StructArray, freeze_std: float) -> None:
        self._sensors, self._freeze_std = sensors, freeze_std
        self._state = sensors[0]
        self.limits = np.full(3, np.nan)
        self.set_uncertainty()
        self.set_trend(None, None)

    @property
    def ready(self) -> bool:
        """Whether background and noise are known, possibly provisionally."""
        return self.line is not None and self.noise is not None

    def set_trend(self, line: Line | None, noise: FloatArray | None) -> None:
        """Set trend and noise, and copy them to the sensor state that compiled code reads."""
        s = self._state
        self.line, self.noise = line, noise
        s['is_ready'] = self.ready
        if line is not None:
            s['centre'], s['mean'], s['slope'], s['horizon'] = line
        s['noise'] = np.nan if noise is None else noise
        self.apply_steps()

    def apply_steps(self) -> None:
        """Update the quantisation variance of the sensor, its total noise and `limits`."""
        core.apply_steps(self._sensors, self._freeze_std, self.limits)

    def set_uncertainty(self, std: FloatArray | float = 0.0, is_provisional: bool = False) -> None:
        """Set the std of the level, (3,) or scalar T, and whether the trend is preliminary."""
        self.is_provisional = is_provisional
        self._state['level_variance'] = np.where(np.isnan(std), 0.0, np.square(std))

    def without_dead_axes(self, noise: FloatArray) -> FloatArray:
        """Noise (3, 3) with NaN for dead axes: constant although their steps are not coarse."""
        steps, variance = corrected_steps(self._sensors), noise.diagonal()
        if np.isfinite(steps).all() and (variance > core.MIN_STD**2).all():
            return noise
        steps = completed_steps(variance, steps)
        is_dead = ~np.isfinite(steps) | (steps == 0.0) & (variance <= core.MIN_STD**2)
        return np.where(is_dead[:, None] | is_dead, np.nan, noise)

    @property
    def covariance(self) -> FloatArray | None:
        """Noise (3, 3) T² of one sample with quantisation; None if unknown, NaN if unreported."""
        if self.noise is None:
            return None
        covariance: FloatArray = self.noise + np.diag(self._state['step_variance'])
        return covariance

    @property
    def drift(self) -> FloatArray:
        """Drift, (3,) T/s; NaN before the background is ready, and for unreported axes."""
        return np.full(3, np.nan) if self.line is None else self.line[2]

    def level(self, time: float) -> FloatArray:
        """Background (3,) T at a time in s; raises ValueError if it is not ready."""
        return -self.difference(time, np.zeros(3))

    def levels(self, times: FloatArray) -> FloatArray:
        """Background (k, 3) T at times (k,) in s; it must be ready."""
        assert self.line is not None
        centre, mean, slope, horizon = self.line
        return mean + (np.minimum(times, horizon) - centre)[:, None] * slope

    def difference(self, time: float, field: FloatArray) -> FloatArray:
        """Field (3,) T minus the background; raises ValueError if the background is not ready."""
        if self.line is None:
            raise ValueError('the background has not been learnt yet')
        out = np.empty(3)
        core.subtract(self._sensors, time, plain(field), out)
        return out

    def are_steady(self, blocks: Blocks) -> bool:
        """Whether blocks lie on one line within `limits`, and have similar noise."""
        centre, mean, slope = line_through(blocks)
        residual = np.abs(blocks.mean - mean - slope * (blocks.time - centre)[:, None])
        return not has_noisy_block(blocks, self._state['step_variance']) \
            and bool(np.nanmax(residual / self.limits) <= 1.0)

    def is_steep(self, blocks: Blocks, slope: FloatArray) -> bool:
        """Whether the slope (3,) T/s of a line through blocks clearly exceeds `STEEP_DRIFT`."""
        assert self.noise is not None
        variance = self.noise.diagonal() + self._state['step_variance']
        relative_time = blocks.time - blocks.time.mean()
        spread = (blocks.n * np.square(relative_time)[:, None]).sum(axis=0)
        std = np.sqrt(variance / np.where(spread > 0.0, spread, np.nan))
        # A comparison with NaN is false: an axis that is not reported has no slope.
        return bool((np.abs(slope) > STEEP_DRIFT + MIN_SLOPE_STDS * std).any())


class FormerLevel(NamedTuple):
    """Level (3,) [T] of the previous background, until [s], and for how long it was observed."""

    until: float
    level: FloatArray
    observed_s: float


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

    def __init__(self, learn: float, relearn: float, sensors: StructArray, level: BackgroundLevel,
                 evaluate_change: ChangeEvaluator) -> None:
        self._learn, self._relearn = learn, relearn
        self._state, self._level = sensors[0], level
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

    def steady_end(self, ratio: float = 1.0) -> Sequence[Block] | None:
        """Three or more latest blocks if steady for `ratio` of the usual time; set `was_steady`."""
        blocks, latest = self.blocks, deque[Block]()
        start = blocks[-1].time - ratio * self._learn
        if len(blocks) < 3 or blocks[0].time > start:
            return None
        for block in reversed(blocks):
            if block.time <= start and len(latest) >= 3:
                break
            latest.appendleft(block)
        if not self._level.are_steady(stacked(latest)):
            return None
        self.was_steady = True
        return latest

    def relearn_time(self, observed_s: float, relearns_soon: bool) -> float:
        """Time [s] on a steady level, observed for `observed_s`, until it becomes the background;
        0 for never. `relearns_soon`: the sensor or its surroundings may have changed."""
        if relearns_soon:
            return min(self._relearn or inf, max(self._learn, MIN_RELEARN_S))
        if self.has_arrived:
            return self._relearn
        # A vehicle present from the start may have departed.
        return self._relearn and min(
            self._relearn, max(self._learn, MIN_RELEARN_S, MIN_DURATION_RATIO * observed_s))

    def former_observed_s(self) -> float:
        """Duration [s] for which the former level was observed; 0 if the latest block left it."""
        if self.former is None or (age := self.blocks[-1].time - self.former.until) > MAX_AGE_S:
            return 0.0
        limits = self._level.limits
        tolerance = limits + np.minimum(TYPICAL_DRIFT * age, MAX_DRIFT * limits)
        # A comparison with NaN is false: an axis that is not reported does not differ.
        differs = (np.abs(self.blocks[-1].mean - self.former.level) > tolerance).any()
        return 0.0 if differs else self.former.observed_s

    def has_departed(self, new_blocks: Sequence[Block]) -> bool | None:
        """Determine and store whether a vehicle in the background has departed (None: unknown)."""
        if self.has_arrived or not self._has_first_block or len(self.blocks) > MAX_EVALUATED_BLOCKS:
            return False if self.has_arrived else None
        blocks = stacked([*self._blocks_before, *self.blocks])
        has_departed = self._evaluate_change(level_change(
            blocks, len(new_blocks), self._level.levels(blocks.time), self._state['noise_std'],
            int(self._state['first_ns']) / NS))
        self.has_arrived = has_departed is False
        if has_departed and self.former is None and self.departed_at is None:
            self.departed_at = new_blocks[0].time
        return has_departed
