"""Running estimate of the background and noise of one sensor from intervals without a target.

The background is a line in time (level and drift) through the means of short blocks of readings;
the noise is pooled from the scatter within the blocks. A block is quiet if its mean is within the
noise limits of the line. Any other block freezes the estimate and discards the blocks shortly
before it, because a target approaches gradually. If there is no quiet interval, the most frequent
level serves as a provisional background. TSP14 section VI and T10 section 6.3 use the mean and
covariance of a target-free interval; the line and the freezing are additions of this package.
"""

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.calibration.background_level import (
    SHORTENED_FRACTION,
    BackgroundLevel,
    FormerLevel,
    LevelDeparture,
)
from mag_tracking.calibration.blocks import (
    Block,
    Blocks,
    LearningWindow,
    QuietInterval,
    block_of,
    line_through,
    pooled_covariance,
    stacked,
)
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, doubtful_since, updated
from mag_tracking.calibration.frequent_level import (
    MIN_DURATION_RATIO,
    MIN_OBSERVED_S,
    MostFrequentLevel,
    ProvisionalLevel,
)
from mag_tracking.calibration.level_change import ChangeEvaluator
from mag_tracking.calibration.sensor_state import corrected_steps
from mag_tracking.units import NS

MAX_CHANGES = 16
"""Maximum number of stored changes of the background."""


class RelearntBackground(NamedTuple):
    """Replacement of a background by another level."""

    stamp_ns: int
    """Timestamp of the first reading to which the new background applies."""
    has_departed: bool
    """Whether a target in the background has departed, or else another level lasted or returned."""
    before: FloatArray
    after: FloatArray
    """Previous and new background, (3,) T, sensor frame. NaN for a missing axis."""


class RunningBackground(BackgroundLevel):
    """Running estimate of a sensor's background; times are in s since the first reading.

    Parameters
    ----------
    learn, memory, guard, block : s, quiet time required before the background is ready, length of
        the fitted interval, delay after which a quiet block enters it, length of a block
    freeze_std : number of noise std by which the mean of a departing block differs
    relearn : s, duration of another steady level after which it becomes the background
        Shorter if the background was observed briefly or contains the field of a departed target.
        0 disables the replacement, except of a background set by `resume`.
    background, noise_std : (3,) T, known in advance
    phase : extra length of the first block, as a fraction of `block`
        It staggers the blocks of sensors that started together. If it is given, each complete block
        is evaluated by a later call of `evaluate_block`, at the latest before the next reading;
        otherwise when it is complete.
    sensors : (1,) SENSOR array with the current block, and the line and noise for compiled code
    evaluate_change : classifies level changes together with the changes at other sensors

    Attributes
    ----------
    frozen : whether the field departs from the background, e.g. because of a target
    stuck : whether the readings do not change
    n_relearnt, relearnt : number of times another steady level became the background, latest ones
    doubtful_times : intervals in which the background was doubtful
    """

    def __init__(self, learn: float, memory: float, guard: float, block: float,
                 freeze_std: float, relearn: float, background: FloatArray | None = None,
                 noise_std: FloatArray | None = None, phase: float | None = None, *,
                 sensors: StructArray, evaluate_change: ChangeEvaluator) -> None:
        self._learn, self._block_length, self._relearn = learn, block, relearn
        super().__init__(sensors, freeze_std)
        self._state['length'], self._state['phase'] = block, np.nan if phase is None else phase
        self._max_blocks = max(3, int(round(memory / block)))
        self._quiet = QuietInterval(guard, self._max_blocks)
        self._learning_window = LearningWindow(learn, block, self._max_blocks)
        self._known_background = None if background is None else np.asarray(background, dtype=float)
        self._known_noise: FloatArray | None = \
            None if noise_std is None else np.diag(np.asarray(noise_std, float) ** 2)
        self.n_relearnt = 0
        self.relearnt: tuple[RelearntBackground, ...] = ()
        # Background and level (3,) [T] of the latest departure.
        self._previous_level: FloatArray = np.full(3, np.nan)
        self._departure_level: FloatArray = np.full(3, np.nan)
        self.doubtful_times: DoubtfulTimes = ()
        self._provisional = ProvisionalLevel(learn)
        self._departure = LevelDeparture(learn, relearn, sensors, self, evaluate_change)
        self.forget()

    def forget(self) -> None:
        """Discard the learnt background and noise; values given in advance are retained."""
        self._state['n'], self._state['end'], self._state['is_full'] = 0, np.nan, False
        self._quiet.clear()
        self._learning_window.clear()
        self._departure.forget()
        self.frozen = self.stuck = False
        self._is_resumed = self._relearns_soon = self._is_ambiguous = self._is_steep = False
        self._provisional.clear()
        # Frames still in the pipeline remain doubtful.
        self.doubtful_times = updated(self.doubtful_times, int(self._state['last_ns']), False)
        # Duration for which the level was observed, its end, and the start of the background.
        self._observed_s = 0.0 if self._known_background is None else inf
        self._observed_until = self._start_time = np.nan
        self.set_uncertainty()
        self.set_trend(None if self._known_background is None
                       else (0.0, self._known_background, np.zeros(3), 0.0), self._known_noise)

    def _set_constant(self, level: FloatArray, noise: FloatArray) -> None:
        """Set a constant level (3,) T, and its noise (3, 3) T² unless that is known."""
        self.set_trend((0.0, level, np.zeros(3), 0.0),
                       noise if self._known_noise is None else self._known_noise)

    def resume(self, background: FloatArray, covariance: FloatArray) -> None:
        """Resume with a recently stored background (3,) T and noise (3, 3) T² of a reading.

        NaN marks an unreported axis. The level remains constant until a quiet interval of `learn`.
        """
        self._set_constant(np.asarray(background, dtype=float), np.asarray(covariance, dtype=float))
        self._is_resumed = self._relearns_soon = True
        self._observed_s, self._is_steep = inf, False
        self.set_uncertainty()

    def start_from(self, level: FloatArray, covariance: FloatArray) -> None:
        """Start with a level (3,) T and noise (3, 3) T² determined from other readings.

        Unlike after `resume`, another level must last for the full `relearn` time to replace it. No
        effect if the noise of all axes is unknown.
        """
        # The noise of a constant axis is unknown if its steps are, or are too fine to observe.
        steps = corrected_steps(self._sensors)
        is_unknown = (covariance.diagonal() <= core.MIN_STD**2) & ~(
            np.isfinite(steps) & (steps > 0.0))
        covariance = np.where(is_unknown[:, None] | is_unknown, np.nan, covariance)
        if not np.isnan(covariance).all():
            self.resume(level, covariance)
            self._relearns_soon = False

    @property
    def doubtful(self) -> bool:
        """Whether the background is provisional or may contain the field of a target."""
        return self.is_provisional or self._is_ambiguous or self._is_steep

    @property
    def departed_at(self) -> float | None:
        """Time [s] by which a vehicle present at the start had left; None if none was detected."""
        return self._departure.departed_at

    @property
    def certain(self) -> bool:
        """Whether the background is ready and not doubtful."""
        return self.ready and not self.doubtful

    @property
    def scatter_std(self) -> FloatArray:
        """Standard deviation (3,) T of quiet readings, with quantisation; NaN if unknown."""
        covariance = pooled_covariance(self._quiet.blocks()) if self._quiet else None
        if covariance is None:
            return np.full(3, np.nan)
        variance = covariance.diagonal() + self._state['step_variance']
        return np.where(variance > 0.0, np.sqrt(variance), np.nan)

    @property
    def measured(self) -> bool:
        """Whether the background was measured rather than given."""
        return bool(self._quiet) and self.ready

    def evaluate_block(self) -> None:
        """Evaluate the latest complete block, unless it has been evaluated already."""
        if not self._state['is_full']:
            return
        block = block_of(self._sensors)
        self._state['is_full'] = False
        is_constant = (block.n > 1) & (block.scatter.diagonal() < core.MIN_STD**2 * (block.n - 1))
        if self.ready and not self.is_provisional:
            self.apply_steps()
            # A constant axis is at rest if its steps are coarse, and stuck if they are fine.
            self.stuck = bool((is_constant & (self._state['step_variance'] == 0.0)
                               & ~np.isnan(self._state['noise_std'])).any())
            if not self.stuck:
                self._update(block)
        else:
            self.stuck = bool(is_constant[block.n > 1].all())
            self._collect_until_quiet(block)
        self.doubtful_times = updated(self.doubtful_times, int(self._state['last_ns']),
                                      self.doubtful)

    def _collect_until_quiet(self, block: Block) -> None:
        """Add a block; adopt the latest quiet interval as the background if it is long enough, or
        else the given background or a frequent level, provisional if uncertain."""
        self._start_time = block.time if np.isnan(self._start_time) else self._start_time
        segments = self._learning_window.segments(block, self.stuck)
        if any(self._adopt_if_steady(s) for s in segments) or self.stuck:
            return
        self._provisional.collect(block)
        frequent = self._provisional.frequent_level(corrected_steps(self._sensors))
        if frequent is None:
            return
        if self._known_background is not None:
            self.start_from(self._known_background, frequent.covariance)
            self._learning_window.clear()
        elif frequent.is_certain:
            self._start_with_frequent(frequent)
        elif not np.isnan(noise := self.without_dead_axes(frequent.covariance)).all():
            self._set_constant(frequent.level, noise)
            self.set_uncertainty(self._provisional.std(frequent), is_provisional=True)

    def _start_with_frequent(self, frequent: MostFrequentLevel) -> None:
        """Adopt a frequent level as the background; another level may still replace it."""
        self.start_from(frequent.level, frequent.covariance)
        self._quiet.clear()  # Its blocks are those of the previous level.
        self._observed_s, self.frozen, self._is_ambiguous = frequent.observed_s, False, False
        self._learning_window.clear()
        self._departure.end()

    def _update(self, block: Block) -> None:
        """Extend the quiet interval by a block, or freeze the background."""
        difference = np.abs(self.difference(block.time, block.mean))
        # A comparison with NaN is false: an axis that is not reported freezes nothing.
        self.frozen = bool((difference > self.limits).any())
        self._provisional.collect(block)
        if self.frozen:
            self._departure.add(block, self._quiet.pending)
            self._quiet.pending.clear()
            self._change_if_steady(block)
            return
        self._is_ambiguous = False
        if self._departure.was_steady:
            self._provisional.clear()  # The level of the vehicle, which has left, is obsolete.
        if not np.isnan(self._observed_until):
            self._observed_s += block.time - self._observed_until
        self._observed_until = block.time
        self._departure.end()
        for blocks in self._quiet.extend(block):
            self._fit(blocks)

    def _change_if_steady(self, block: Block) -> None:
        """While frozen, adopt another level that persists or that was the background earlier."""
        self._observed_until = np.nan
        self._previous_level, self._departure_level = self.level(block.time), block.mean
        departure = self._departure
        duration = block.time - departure.blocks[0].time
        relearn_time = departure.relearn_time(
            self._observed_s, self._is_resumed and self._relearns_soon)
        if not relearn_time:
            return departure.end()
        other_level = self._provisional.frequent_level(corrected_steps(self._sensors))
        if other_level is not None and other_level.is_at(self.level(block.time)):
            other_level = None
        new_blocks = departure.steady_end(SHORTENED_FRACTION)
        if new_blocks is not None and self._relearn and self._adopt_if_background(new_blocks):
            return
        # Either of two levels of equal duration may be the background, unless a vehicle was
        # observed to arrive at one of the levels.
        self._is_ambiguous = not departure.has_arrived and (
            self._is_ambiguous
            or duration >= min(self._observed_s, self._relearn)
            and departure.steady_end() is not None
            or other_level is not None
            and other_level.observed_s >= min(self._observed_s, MIN_OBSERVED_S))
        if duration < relearn_time:
            return
        if self._adopt_if_steady(departure.blocks):
            self._count_relearnt(False)
            self.frozen = self._is_ambiguous = False
        elif other_level is not None and other_level.is_certain:
            self._count_relearnt(False)
            self._start_with_frequent(other_level)
        else:
            departure.shorten()

    def _count_relearnt(self, has_departed: bool) -> None:
        """Count another background, which applies from the latest reading on."""
        self.n_relearnt += 1
        change = RelearntBackground(int(self._state['last_ns']), has_departed,
                                    self._previous_level, self._departure_level)
        self.relearnt = (*self.relearnt, change)[-MAX_CHANGES:]

    def _adopt_if_background(self, new_blocks: Sequence[Block]) -> bool:
        """Adopt a former level, or a level after a vehicle departed; return whether adopted."""
        former_observed_s = self._departure.former_observed_s()
        if former_observed_s:
            self._change_to(new_blocks, former_observed_s, False)
            return True
        is_known = self._known_background is not None and self._departure.former is None
        if not self._departure.has_departed(new_blocks) or is_known:
            return False
        since_ns = int(self._state['first_ns']) + round(np.nan_to_num(self._start_time) * NS)
        self._change_to(new_blocks, self._learn, True)
        # The earlier background contained the field of the vehicle.
        self.doubtful_times = doubtful_since(self.doubtful_times, since_ns)
        return True

    def _change_to(self, new_blocks: Sequence[Block], observed_s: float,
                   has_departed: bool) -> None:
        """Change the background to the level of `new_blocks`, observed for `observed_s` [s]."""
        # The first half may contain the tail of the departing vehicle's field.
        second_half = list(new_blocks)[len(new_blocks) // 2:]
        self._store_former_level(second_half[0].time)
        self.set_trend((0.0, line_through(stacked(second_half))[1], np.zeros(3), 0.0), self.noise)
        self._is_resumed, self._relearns_soon, self._observed_s = True, False, observed_s
        self._quiet.begin(second_half)
        self._count_relearnt(has_departed)
        self.frozen = self._is_ambiguous = self._is_steep = False

    def _store_former_level(self, begin: float) -> None:
        """Store the present level as the former level, which ended at `begin` [s]."""
        self._start_time = begin
        self._departure.former = FormerLevel(begin, self.level(begin), self._observed_s)
        self._departure.end()

    def _adopt_if_steady(self, collected: deque[Block]) -> bool:
        """Adopt blocks that all lie on one line as the background; return whether adopted."""
        blocks = stacked(collected)
        noise = pooled_covariance(blocks) if self._known_noise is None else self._known_noise
        noise = None if noise is None else self.without_dead_axes(noise)
        if noise is None or np.isnan(noise).all():
            return False
        previous_noise = self.noise
        self.set_trend(self.line, noise)
        if not self.are_steady(blocks):
            self.set_trend(self.line, previous_noise)
            return False
        if self._known_background is not None and self.line is not None \
                and not self.n_relearnt and not self.frozen:
            # The background was given and only the noise had to be learnt.
            self._learning_window.clear()
            return True
        if self.frozen and self.line is not None:
            self._store_former_level(float(blocks.time[0]))
        # The required length was checked by the caller; the initial length does not apply.
        self._is_resumed = False
        self._observed_s = float(blocks.time[-1] - blocks.time[0]) + self._block_length
        self._observed_until = float(blocks.time[-1])
        self.set_uncertainty()
        self._quiet.begin(collected)
        self._learning_window.clear()
        self._fit(self._quiet.blocks())
        return True

    def _fit(self, blocks: Blocks) -> None:
        """Fit line and noise; keep a given or resumed background until the blocks span `learn`."""
        if (self._known_background is not None or self._is_resumed) \
                and np.ptp(blocks.time) < self._learn:
            return
        self._is_resumed = False
        # The drift is extrapolated for at most twice the duration of the blocks.
        first, last = float(blocks.time.min()), float(blocks.time.max())
        line = *line_through(blocks), last + 2.0 * (last - first)
        is_briefly_observed = MIN_DURATION_RATIO * self._observed_s < self._relearn
        self._is_steep = is_briefly_observed and self.is_steep(blocks, line[2])
        self.set_uncertainty(np.abs(line[2]) * self._learn if self._is_steep else 0.0)
        noise = pooled_covariance(blocks) if self._known_noise is None else None
        self.set_trend(line, self.noise if noise is None else self.without_dead_axes(noise))
