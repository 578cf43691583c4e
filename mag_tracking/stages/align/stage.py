"""Align: combine the asynchronous samples of many sensors into frames of the whole network.

A frame is completed only when every active sensor has delivered a newer sample or, in burst mode,
its sample of the round. Therefore frames do not depend on the order in which messages arrive.
"""

from collections import Counter

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.sensor_network import MIN_DELAY_BASELINE
from mag_tracking.records import FieldFrame, Readings, plain
from mag_tracking.stages.align import core
from mag_tracking.stages.align.clock_step import ClockStepFilter, HeldSample
from mag_tracking.stages.settings import AlignSettings
from mag_tracking.stages.stage import MAX_BACKWARD_JUMP_S, Stage
from mag_tracking.units import NS

DEFAULT_PERIOD_S = 0.08
"""[s] Default frame period: 12.5 Hz, as in T10 section 6.3 for sensors nine metres apart."""
MIN_AUTO_PERIOD_S = 0.02
"""[s] Minimum automatic frame period; 100 frames per second occupy a whole core."""
MIN_PERIOD_S = 1e-4
"""[s] Minimum configurable frame period; no sensor has a shorter sample interval."""
MAX_TARGET_SPEED = 20.0
"""[m/s] Frames are designed for targets up to this speed."""
UNLIMITED_NS = np.iinfo(np.int64).max
"""[ns] Later than any timestamp."""
MAX_HELD = 16
"""Maximum number of samples per sensor that are held while a clock step is unconfirmed."""
CAUSES = {
    core.NO_FIELD: 'no finite field',
    core.NO_COVARIANCE: 'unknown covariance, and no noise_std in the network',
    core.DUPLICATE: 'duplicate timestamp',
    core.OUT_OF_ORDER: 'out of order',
    core.LATE: 'late',
}
"""Cause of rejection for each reason code, except causes that name a sensor."""


def shortest_delay(network: SensorNetwork) -> tuple[float, str, str] | None:
    """Shortest time [s] of a target at `MAX_TARGET_SPEED` between two sensors, and their names;
    None if all sensors have nearly the same horizontal position."""
    shortest, pair = np.inf, None
    for j, position in enumerate(network.positions):
        distance = np.linalg.norm((network.positions[:j] - position)[:, :2], axis=1)
        distance[distance <= MIN_DELAY_BASELINE] = np.inf
        if distance.min(initial=np.inf) < shortest:
            i = int(np.argmin(distance))
            shortest, pair = float(distance[i]), (network.names[i], network.names[j])
    return None if pair is None else (shortest / MAX_TARGET_SPEED, *pair)


def frame_period(settings: AlignSettings, network: SensorNetwork) -> float:
    """Frame period [s]: the setting or, if 0 in a compact network, half the shortest delay between
    two sensors, whose signals longer frames mix; raises SettingsError if it is too short."""
    if 0.0 < settings.period_s < MIN_PERIOD_S:
        raise SettingsError(f'align.period_s: {settings.period_s:g} s is shorter than the minimum '
                            f'of {MIN_PERIOD_S:g} s; set it to 0 for an automatic period')
    if settings.period_s:
        return settings.period_s
    shortest = shortest_delay(network)
    if settings.burst or shortest is None or not network.is_compact:
        return DEFAULT_PERIOD_S
    return min(DEFAULT_PERIOD_S, max(MIN_AUTO_PERIOD_S, 0.5 * shortest[0]))


def frame_period_warning(settings: AlignSettings, network: SensorNetwork) -> str | None:
    """Warning if the setting exceeds the travel time between sensors, except in bursts."""
    shortest, period = shortest_delay(network), frame_period(settings, network)
    if not settings.period_s or settings.burst or shortest is None or period <= shortest[0]:
        return None
    delay, first, second = shortest
    return (f'align.period_s: a frame of {1e3 * period:.0f} ms is longer than the '
            f'{1e3 * delay:.0f} ms that a target at {MAX_TARGET_SPEED:.0f} m/s takes from {first} '
            f'to {second}, which makes speed and direction less accurate; set align.period_s to 0 '
            'for an automatic period')


class Align(Stage[Readings, FieldFrame]):
    """Combines calibrated readings into frames, by the rules in `alignment.hpp`."""

    def __init__(self, network: SensorNetwork, settings: AlignSettings) -> None:
        self.counts: Counter[str] = Counter()
        self._noise = np.array([np.full((3, 3), np.nan) if std is None else np.diag(std ** 2)
                                for std in network.noise_std]).reshape(-1, 3, 3)
        self._index = {name: i for i, name in enumerate(network.names)}
        self._names, self._settings = network.names, settings
        self._period = int(round(frame_period(settings, network) * NS))
        self._reset()

    def _reset(self) -> None:
        """Reset to the initial state."""
        settings = self._settings
        longest_jump = int(round(settings.max_clock_jump_s * NS)) or UNLIMITED_NS
        self._alignment = core.Alignment(
            len(self._names), self._period, int(round(settings.max_wait_s * NS)), longest_jump,
            int(round(MAX_BACKWARD_JUMP_S * NS)), settings.max_buffered, settings.burst)
        self._clock_steps = ClockStepFilter(len(self._names), longest_jump,
                                            min(settings.max_buffered, MAX_HELD))

    @property
    def n_held(self) -> int:
        """Number of samples that wait for their frame or for confirmation of their timestamps."""
        return self._alignment.n_pending + len(self._clock_steps.held)

    @property
    def n_held_ahead(self) -> int:
        """Number of samples that are held because their timestamps jumped ahead."""
        return len(self._clock_steps.held)

    def feed(self, readings: Readings) -> list[FieldFrame]:
        """Add calibrated readings, and return the completed frames."""
        rows, C = readings.rows(self._index), readings.covariance
        if C is None:
            C = self._noise[rows]
        else:
            is_unknown = readings.has_unknown_covariance()
            if is_unknown.any():
                C = np.where(is_unknown[:, None, None], self._noise[rows], C)
        return self._hold(rows, plain(readings.stamp_ns, np.int64), plain(readings.field),
                          plain(C), readings)

    def _hold(self, rows: IntArray, stamps: IntArray, fields: FloatArray, covariances: FloatArray,
              readings: Readings | None = None) -> list[FieldFrame]:
        """Queue samples, and return the completed frames; `readings` is None if the samples have
        already passed the clock step filter."""
        out: list[FieldFrame] = []
        k = 0
        while True:
            alignment, steps = self._alignment, self._clock_steps
            alignment.next, alignment.passed, alignment.is_calm = k, steps.newest, steps.is_calm
            reason = alignment.hold(readings is None, steps.latest, rows, stamps, fields,
                                    covariances)
            k, steps.newest = alignment.next, alignment.passed
            if reason == core.DONE:
                return out
            if reason == core.COMPLETE:
                out += self._frames()
            elif reason == core.UNKNOWN_SENSOR:
                assert readings is not None
                self._reject(f'unknown sensor {readings.names[readings.sensor[k - 1]]}')
            elif reason == core.CLOCK_STEP:
                released, rejected = self._clock_steps.feed(int(rows[k - 1]), HeldSample(
                    int(stamps[k - 1]), fields[k - 1], covariances[k - 1]))
                for j, _ in rejected:
                    self._reject(f'ahead of all other sensors: {self._names[j]}')
                out += self._hold_passed(released)
            elif reason == core.JUMPED_BACK:
                out += self.flush()
                self._reset()
                self.counts['time jumped back'] += 1
                sample = slice(k, k + 1)
                out += self._hold(rows[sample], stamps[sample], fields[sample], covariances[sample])
                k += 1
            elif reason == core.TOO_MANY:
                alignment.drop(alignment.row)
                self._reject('too many pending samples')
                out += [] if alignment.waits() else self._frames()
            else:
                self._reject(CAUSES[reason])

    def _hold_passed(self, passed: list[tuple[int, HeldSample]]) -> list[FieldFrame]:
        """Queue samples that have passed the clock step filter, and return the completed frames."""
        out: list[FieldFrame] = []
        for i, s in passed:
            out += self._hold(np.array([i]), np.array([s.stamp_ns]), s.field[None],
                              s.covariance[None])
        return out

    def flush(self) -> list[FieldFrame]:
        """Return all frames of the held and pending samples at the end of the input."""
        return self._hold_passed(self._clock_steps.flush()) + self._frames(final=True)

    def _reject(self, cause: str) -> None:
        """Count a rejected sample by cause."""
        self.counts[f'rejected: {cause}'] += 1

    def _frames(self, final: bool = False) -> list[FieldFrame]:
        """Return the complete frames or, if the input has ended (`final`), all frames."""
        out: list[FieldFrame] = []
        while (arrays := self._alignment.frame(final)) is not None:
            frame = FieldFrame(*arrays)
            self.counts['frames'] += 1
            if not frame.n_samples.all():
                self.counts['frames with a sensor missing'] += 1
            out.append(frame)
        return out
