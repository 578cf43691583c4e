"""Distinguish a forward step of one clock, which would make the samples of all other sensors appear
late, from a gap in the samples of all sensors."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.units import NEVER


class HeldSample(NamedTuple):
    """A sample that the clock step filter checks, and holds if its timestamp has jumped ahead."""

    stamp_ns: int
    field: FloatArray
    """Flux density, (3,) T, sensor frame."""
    covariance: FloatArray
    """Covariance of `field`, (3, 3) T²."""


SensorSamples = list[tuple[int, HeldSample]]
"""Samples, each with the index of its sensor, in order of arrival."""


class ClockStepFilter:
    """Holds samples whose timestamps jump ahead, until other sensors confirm or refute the jump.

    Jumps of up to `max_jump` [ns] pass unchecked. A jump is also accepted if its sensor advances by
    `max_jump` while no sample of another sensor is accepted. A held sample is rejected if it is not
    confirmed before the timestamps of its own sensor, or of the others, advance by more than this,
    or if its sensor has more than `max_held`. `latest` (n_sensors,) and `newest` [ns] are the
    latest accepted timestamps of each and of any sensor.
    """

    def __init__(self, n_sensors: int, max_jump: int, max_held: int) -> None:
        self._max_jump, self._max_held = max_jump, max_held
        self.latest, self.newest = np.full(n_sensors, NEVER), NEVER
        # (sensor index, sample, newest accepted timestamp at its arrival), in order of arrival.
        self.held: list[tuple[int, HeldSample, int]] = []
        # {index of a sensor that is ahead: (newest accepted timestamp, timestamp of its jump)}
        self._ahead_since: dict[int, tuple[int, int]] = {}

    @property
    def is_calm(self) -> bool:
        """Whether no clock step is suspected: samples that do not jump then bypass the filter."""
        if not self.held and not self._ahead_since:
            return True
        # The entry of a sensor without held samples expires when a newer timestamp is accepted.
        return not self.held and all(
            newest != self.newest for newest, _ in self._ahead_since.values())

    def feed(self, i: int, sample: HeldSample) -> tuple[SensorSamples, SensorSamples]:
        """Check a sample of sensor `i`; return samples now accepted and rejected, in order."""
        stamp = sample.stamp_ns
        if not self._jumps(i, stamp):
            passed = self._accept([(i, sample)])
        else:
            self.held.append((i, sample, self.newest))
            if self._ahead_since.get(i, (NEVER,))[0] != self.newest:
                self._ahead_since[i] = self.newest, stamp
            if not (self._majority_follows(stamp) or self._advances_alone(i, stamp)):
                return [], self._release_expired(i, stamp)
            # Samples that are even further ahead remain held.
            passed = self._accept(self._release(
                lambda _, s, __: s.stamp_ns <= stamp + self._max_jump))
        # The sensor agrees with the other sensors again, so its held samples had wrong timestamps.
        # Samples that were not confirmed in time also had wrong timestamps. The first held
        # sample is the oldest one.
        if i in self._ahead_since or self.held and self.newest - self.held[0][2] > self._max_jump:
            self._ahead_since.pop(i, None)
            return passed, self._release(
                lambda j, _, newest: j == i or self.newest - newest > self._max_jump)
        return passed, []

    def flush(self) -> SensorSamples:
        """Accept and return all held samples at the end of the input."""
        return self._accept(self._release(lambda *_: True))

    def _jumps(self, i: int, stamp: int) -> bool:
        """Whether a timestamp of sensor `i` jumps by more than `max_jump` and must be checked."""
        if self.newest == NEVER or stamp <= self.newest + self._max_jump:
            return False
        # With two sensors, the first sample of one is as credible as the samples of the other.
        return self.latest[i] != NEVER or bool(self.held) or len(self._active_sensors()) > 1

    def _accept(self, samples: SensorSamples) -> SensorSamples:
        """Record samples as accepted, and return them."""
        for i, sample in samples:
            self.latest[i] = sample.stamp_ns
            self.newest = max(self.newest, sample.stamp_ns)
        return samples

    def _active_sensors(self) -> set[int]:
        """Indices of the sensors whose latest timestamp is at most `max_jump` before `newest`."""
        return {j for j, latest in enumerate(self.latest.tolist())
                if latest != NEVER and latest >= self.newest - self._max_jump}

    def _majority_follows(self, stamp: int) -> bool:
        """Whether most of the active sensors have a held sample within `max_jump` of `stamp`."""
        following = {j for j, s, _ in self.held if abs(s.stamp_ns - stamp) <= self._max_jump}
        return 2 * len(following) > len(following | self._active_sensors())

    def _advances_alone(self, i: int, stamp: int) -> bool:
        """Whether sensor `i` has advanced by `max_jump` since its jump."""
        return stamp - self._ahead_since[i][1] >= self._max_jump

    def _release_expired(self, i: int, stamp: int) -> SensorSamples:
        """Remove and return held samples of sensor `i` that are too old or too many."""
        own_samples = [s for j, s, _ in self.held if j == i]
        oldest = own_samples[0] if len(own_samples) > self._max_held else None
        return self._release(lambda j, s, _: j == i and (
            s.stamp_ns < stamp - self._max_jump or s is oldest))

    def _release(self, is_released: Callable[[int, HeldSample, int], bool]) -> SensorSamples:
        """Remove and return the held samples for which `is_released` returns True."""
        if not self.held:
            return []
        out = [h[:2] for h in self.held if is_released(*h)]
        self.held = [h for h in self.held if not is_released(*h)]
        return out
