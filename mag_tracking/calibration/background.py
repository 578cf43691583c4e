"""Background field and noise of one sensor, learnt from target-free stretches.

The background is a straight line in time (level and drift) through the means of short quiet blocks;
the noise is their pooled scatter. A block that departs from the line freezes the learning, and
takes with it what was learnt shortly before: a target comes near gradually. Without a quiet stretch
the most frequent level is a provisional background. Source: TSP14 section VI, T10 section 6.3 (mean
and covariance of a target-free stretch); the line and the freezing are this package's own.
"""

from collections import deque
from functools import partial
from math import inf

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration.background_level import BackgroundLevel
from mag_tracking.calibration.blocks import Block, Blocks, block_of, pooled_covariance, stacked
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, doubted_since, noted
from mag_tracking.calibration.drift import FormerLevel, is_steep
from mag_tracking.calibration.frequent_level import MORE
from mag_tracking.calibration.learning_window import LearningWindow
from mag_tracking.calibration.level_change import Judge, SharedChanges
from mag_tracking.calibration.level_departure import SOONER, LevelDeparture
from mag_tracking.calibration.provisional import SEEN_S, FrequentLevel, ProvisionalLevel
from mag_tracking.calibration.quiet_interval import QuietInterval, line_of
from mag_tracking.calibration.resolution import MIN_STD, corrected_steps
from mag_tracking.units import NS


class RunningBackground:
    """Running estimate of one sensor's background; times in seconds of the records.

    Parameters
    ----------
    learn, memory, guard, block : float [s]
        Quiet time needed before it is ready; length of the stretch that the line is fitted to, and
        how far that stays behind the present; length of a block.
    freeze_std : float
        A block departs if its mean is this many noise deviations off.
    relearn : float [s]
        After so long frozen on a steady level that level is the new background, or earlier if the
        old one was seen only briefly, or was that of something that has left; 0 = never.
    background, noise_std : (3,) [T], optional
        Known beforehand: with both it is ready at once.
    phase : float, optional
        Staggers the blocks of many sensors that began together: the first block is longer by
        this share, and the others follow at even times. A complete block is judged by
        `judge_block`, or before the next reading. Without a phase it is judged at once.
    sensors : (1,) SENSOR
        State of the sensor: holds the present block, and line and noise for compiled code.
    judge : Judge, optional
        Judges the sensor's changes of level together with those of other sensors.

    Attributes
    ----------
    frozen, stuck : bool
        Whether a target is near; whether the readings do not change.
    n_relearnt : int
        How often another steady level was taken for the background.
    doubtful_times : DoubtfulTimes
        When it was `doubtful`.
    """

    def __init__(self, learn: float, memory: float, guard: float, block: float,
                 freeze_std: float, relearn: float, background: FloatArray | None = None,
                 noise_std: FloatArray | None = None, phase: float | None = None, *,
                 sensors: StructArray, judge: Judge | None = None) -> None:
        self._learn, self._length, self._relearn = learn, block, relearn
        self._sensors, self._state = sensors, sensors[0]
        self._state['length'], self._state['phase'] = block, np.nan if phase is None else phase
        self._most = max(3, int(round(memory / block)))
        self._quiet = QuietInterval(guard, self._most)
        self._learning_window = LearningWindow(learn, block, self._most)
        self._given = None if background is None else np.asarray(background, dtype=float)
        self._given_noise: FloatArray | None = \
            None if noise_std is None else np.diag(np.asarray(noise_std, float) ** 2)
        self._level = BackgroundLevel(sensors, freeze_std)
        self.n_relearnt = 0
        self.doubtful_times: DoubtfulTimes = ()
        self._provisional = ProvisionalLevel(learn)
        self._departure = LevelDeparture(learn, relearn, self._state, self._level,
                                    judge or partial(SharedChanges().judge, 0))
        self.forget()

    def forget(self) -> None:
        """Drop what was learnt; what was given beforehand stays."""
        self._state['n'], self._state['end'], self._state['is_full'] = 0, np.nan, False
        self._quiet.clear()
        self._learning_window.clear()
        self._departure.forget()
        self.frozen = self.stuck = False
        self._resumed = self._relearns_soon = self._contested = self._steep = False
        self._provisional.clear()
        # What is doubtful in the frames that are still on their way stays so.
        self.doubtful_times = noted(self.doubtful_times, int(self._state['last_ns']), False)
        # For how long the level was seen, until when, and since when it is the background.
        self._seen_s = 0.0 if self._given is None else inf
        self._seen_until = self._since = np.nan
        self._level.rely()
        self._level.set(None if self._given is None else (0.0, self._given, np.zeros(3), 0.0),
                        self._given_noise)

    def resume(self, background: FloatArray, covariance: FloatArray) -> None:
        """Go on from what was known a moment ago: (3,) [T] and (3, 3) [T^2], NaN as elsewhere.

        It is a line again when a stretch as long as at first has been quiet.
        """
        noise = np.asarray(covariance, dtype=float)
        self._level.set((0.0, np.asarray(background, dtype=float), np.zeros(3), 0.0),
                        noise if self._given_noise is None else self._given_noise)
        self._resumed = self._relearns_soon = True
        self._seen_s, self._steep = inf, False
        self._level.rely()

    def begin_with(self, level: FloatArray, covariance: FloatArray) -> None:
        """Begin with a level that later readings have: (3,) [T] and (3, 3) [T^2].

        As after `resume`, but another level has to last as long as it always has to. Nothing is
        begun where no axis changes.
        """
        covariance = self._level.without_unknown_noise(covariance)
        if not np.isnan(covariance).all():
            self.resume(level, covariance)
            self._relearns_soon = False

    @property
    def ready(self) -> bool:
        """Whether both background and noise are known, if only provisionally."""
        return self._level.is_ready

    @property
    def doubtful(self) -> bool:
        """Whether it is provisional, or that of a target that has left since, or comes near."""
        return self._level.is_provisional or self._contested or self._steep

    @property
    def freed_at(self) -> float | None:
        """[s] When a vehicle that stood there at first was gone; None where there was none."""
        return self._departure.freed_at

    @property
    def certain(self) -> bool:
        """Whether it is ready and not doubtful."""
        return self.ready and not self.doubtful

    @property
    def covariance(self) -> FloatArray | None:
        """(3, 3) [T^2] noise of one sample and its steps, or None; NaN for an axis not reported."""
        return self._level.covariance

    @property
    def drift(self) -> FloatArray:
        """(3,) [T/s] of the background; NaN before it is ready, and of an axis not reported."""
        return self._level.drift

    def level(self, time: float) -> FloatArray:
        """(3,) [T] background at `time` [s]; raises ValueError before it is ready."""
        return self._level.at(time)

    @property
    def scatter_std(self) -> FloatArray:
        """(3,) [T] scatter of the quiet readings and their steps; NaN = unknown."""
        variance = self._quiet.scatter() + self._state['step_variance']
        return np.where(variance > 0.0, np.sqrt(variance), np.nan)

    @property
    def measured(self) -> bool:
        """Whether the background is from readings, not from what was given beforehand."""
        return bool(self._quiet) and self.ready

    def judge_block(self) -> None:
        """Judge the block that the latest sample has shown to be complete."""
        if not self._state['is_full']:
            return
        block = block_of(self._sensors)
        self._state['is_full'] = False
        still = (block.n > 1) & (block.scatter.diagonal() < MIN_STD**2 * (block.n - 1))
        if self.ready and not self._level.is_provisional:
            self._level.apply_steps()
            # An axis with coarse steps rests; one with fine steps is stuck.
            self.stuck = bool((still & (self._state['step_variance'] == 0.0)
                               & ~np.isnan(self._state['noise_std'])).any())
            if not self.stuck:
                self._follow(block)
        else:
            self.stuck = bool(still[block.n > 1].all())
            self._begin(block)
        last_ns = int(self._state['last_ns'])
        self.doubtful_times = noted(self.doubtful_times, last_ns, self.doubtful)

    def _begin(self, block: Block) -> None:
        """Before it is ready: collect until a quiet stretch is long enough."""
        self._since = block.time if np.isnan(self._since) else self._since
        segments = self._learning_window.segments(block, self.stuck)
        if not any(self._adopt_if_steady(s) for s in segments) and not self.stuck:
            self._provide(block)

    def _provide(self, block: Block) -> None:
        """Without a quiet stretch: begin with the most frequent level."""
        self._provisional.collect(block)
        found = self._provisional.found(corrected_steps(self._sensors))
        if found is not None and self._given is not None:
            self.begin_with(self._given, found.level.covariance)
            self._learning_window.clear()
        elif found is not None and found.is_certain:
            self._begin_with_frequent(found)
        elif found is not None:
            level, noise = found.level, self._level.without_dead_axes(found.level.covariance)
            if not np.isnan(noise).all():
                self._level.set((0.0, level.level, np.zeros(3), 0.0),
                                noise if self._given_noise is None else self._given_noise)
                self._level.rely(found.deviation, is_provisional=True)

    def _begin_with_frequent(self, found: FrequentLevel) -> None:
        """Begin with a level that is frequent enough; others may still take its place."""
        self.begin_with(found.level.level, found.level.covariance)
        self._seen_s, self.frozen, self._contested = found.seen_s, False, False
        self._learning_window.clear()
        self._departure.end()

    def _follow(self, block: Block) -> None:
        """Once ready: extend the quiet stretch, or freeze."""
        off = np.abs(self._level.departure(block.time, block.mean))
        # A comparison with NaN is false: an axis that is not reported freezes nothing.
        self.frozen = bool((off > self._level.limits).any())
        self._provisional.collect(block)
        if self.frozen:
            self._departure.add(block, self._quiet.pending)
            self._quiet.pending.clear()
            self._change_if_steady(block)
            return
        self._contested = False
        if self._departure.was_steady:
            self._provisional.clear()  # The vehicle is gone, and its level.
        if not np.isnan(self._seen_until):
            self._seen_s += block.time - self._seen_until
        self._seen_until = block.time
        self._departure.end()
        for blocks in self._quiet.extend(block):
            self._fit(blocks)

    def _change_if_steady(self, block: Block) -> None:
        """While frozen: take another level that lasts, or that was the background before."""
        self._seen_until = np.nan
        departure = self._departure
        since = block.time - departure.blocks[0].time
        longest = departure.longest(self._seen_s, self._resumed and self._relearns_soon)
        if not longest:
            return departure.end()
        other = self._provisional.found(corrected_steps(self._sensors))
        if other is not None and other.level.is_at(self._level.at(block.time)):
            other = None
        latest = departure.steady_end(SOONER)
        if latest is not None and self._relearn and self._judge_change(latest):
            return
        # Two levels that were seen for equally long may both be the background, unless a vehicle
        # was seen to come to one of them.
        self._contested = not departure.has_come and (
            self._contested
            or since >= min(self._seen_s, self._relearn) and departure.steady_end() is not None
            or other is not None and other.seen_s >= min(self._seen_s, SEEN_S))
        if since < longest:
            return
        if self._adopt_if_steady(departure.blocks):
            self.n_relearnt += 1
            self.frozen = self._contested = False
        elif other is not None and other.is_certain:
            self.n_relearnt += 1
            self._begin_with_frequent(other)
        else:
            departure.shorten()

    def _judge_change(self, latest: deque[Block]) -> bool:
        """Whether the level of the `latest` blocks is the background from now on."""
        former_seen_s = self._departure.former_seen_s()
        if former_seen_s:
            self._change_to(latest, former_seen_s)
            return True
        is_given = self._given is not None and self._departure.former is None
        if not self._departure.has_departed(latest) or is_given:
            return False
        since_ns = int(self._state['first_ns']) + round(np.nan_to_num(self._since) * NS)
        self._change_to(latest, self._learn)
        # All before was measured against the vehicle that stood there.
        self.doubtful_times = doubted_since(self.doubtful_times, since_ns)
        return True

    def _change_to(self, latest: deque[Block], seen_s: float) -> None:
        """Go on with the level of the `latest` blocks, which was seen for `seen_s` [s] in all."""
        # The first half may have the tail of the vehicle that has left.
        half = list(latest)[len(latest) // 2:]
        self._depart_from(half[0].time)
        self._level.rest_at(stacked(half))
        self._resumed, self._relearns_soon, self._seen_s = True, False, seen_s
        self._quiet.begin(half)
        self.n_relearnt += 1
        self.frozen = self._contested = self._steep = False

    def _depart_from(self, begin: float) -> None:
        """The present level is the former one, as another is the background since `begin` [s]."""
        self._since = begin
        self._departure.former = FormerLevel(begin, self._level.at(begin), self._seen_s)
        self._departure.end()

    def _adopt_if_steady(self, collected: deque[Block]) -> bool:
        """Take the collected blocks as the background if they lie on one line."""
        blocks = stacked(collected)
        noise = pooled_covariance(blocks) if self._given_noise is None else self._given_noise
        noise = None if noise is None else self._level.without_dead_axes(noise)
        if noise is None or np.isnan(noise).all():
            return False
        before = self._level.noise
        self._level.set(self._level.line, noise)
        if not self._level.holds(blocks):
            self._level.set(self._level.line, before)
            return False
        if self._given is not None and self._level.line is not None and not self.n_relearnt \
                and not self.frozen:
            # The background was given and only the noise had to be learnt.
            self._learning_window.clear()
            return True
        if self.frozen and self._level.line is not None:
            self._depart_from(float(blocks.time[0]))
        # A steady stretch was asked for its own length; it need not be as long as at first.
        self._resumed = False
        self._seen_s = float(blocks.time[-1] - blocks.time[0]) + self._length
        self._seen_until = float(blocks.time[-1])
        self._level.rely()
        self._quiet.begin(collected)
        self._learning_window.clear()
        self._fit(self._quiet.blocks())
        return True

    def _fit(self, blocks: Blocks) -> None:
        """Line and noise from the quiet `blocks`."""
        if (self._given is not None or self._resumed) and np.ptp(blocks.time) < self._learn:
            return
        self._resumed = False
        line = line_of(blocks)
        assert self._level.noise is not None
        is_young = MORE * self._seen_s < self._relearn
        self._steep = is_young and is_steep(
            blocks, line[2], self._level.noise.diagonal() + self._state['step_variance'])
        self._level.rely(np.abs(line[2]) * self._learn if self._steep else 0.0)
        noise = pooled_covariance(blocks) if self._given_noise is None else None
        self._level.set(line, self._level.noise if noise is None
                        else self._level.without_dead_axes(noise))
