"""First pass over a recording, to find backgrounds if a target is present at the start."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.frequent_level import MostFrequentLevel
from mag_tracking.calibration.quiet_level import BlockRecorder
from mag_tracking.calibration.reading_faults import ReadingFaults
from mag_tracking.calibration.sensor_state import N_WINDOW
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.clocks import ClockSpan
from mag_tracking.stages.settings import CalibrateSettings
from mag_tracking.units import NS

LOOK_AHEAD_S = 300.0
"""[s] Duration, from the start of the recording, that is searched for the most frequent level of a
sensor that is not quiet at the start."""
LEARNING_TOLERANCE_S = 1.0
"""Excess over the nominal learning time above which a target is considered present [s]."""
MIN_BLOCKS = 6.0
"""Minimum learning time [blocks], which applies to slow sensors with long blocks."""
MIN_LEVEL_FRACTION = 1.0 / 3.0
"""Minimum total duration of a background level, as a fraction of the learning time."""
N_READINGS_AT_ONCE = 8
"""Number of readings per batch while the initial background is learnt."""
N_BEGINNING = N_WINDOW + 1
"""Number of readings per sensor in which faults of drivers are searched first."""


@dataclass(frozen=True)
class Prescan:
    """Backgrounds, resolutions and faults of drivers found by a first pass over a recording."""

    levels: dict[str, MostFrequentLevel]
    """{sensor: most frequent level}; empty if no target is present at the start."""
    steps: dict[str, FloatArray]
    """{sensor: (3,) smallest change of each axis, T}."""
    faults: dict[str, ReadingFaults]
    """{sensor: faults of the driver}."""
    clocks: dict[str, ClockSpan] = field(default_factory=dict)
    """{sensor: timestamps and times of receipt}; empty if the times of receipt are unknown."""

    def segment_of(self, sensor: str) -> list[float] | None:
        """Interval [s after the first reading] in which a sensor's level was observed."""
        level = self.levels.get(sensor)
        return None if level is None else [level.begin, level.end]

    def apply(self, calibrate: Calibrate) -> None:
        """Initialise the calibration stage with the results."""
        calibrate.start_from(self.levels, self.steps, self.faults)
        calibrate.compare_clocks(self.clocks)


def prescan(batches: Iterable[Readings], network: SensorNetwork,
            settings: CalibrateSettings) -> Prescan:
    """Find the backgrounds that the network file lacks if a target is present at the start."""
    without_background = [name for name, level in zip(network.names, network.background,
                                                      strict=True) if level is None]
    batches = iter(batches)
    beginning, faults = _beginning(batches, network, settings)
    if not without_background:
        return Prescan({}, {}, faults)
    recorder, learner = Calibrate(network, settings, BlockRecorder), Calibrate(network, settings)
    for stage in (recorder, learner):
        stage.start_from({}, {}, faults)
    first_ns: dict[str, int] = {}
    learnt: dict[str, tuple[float, FloatArray]] = {}
    for readings in chain(beginning, batches):
        recorder.feed(readings)
        _learn(learner, readings, first_ns, learnt)
        start_ns = min(first_ns.values(), default=0)
        if len(readings) and int(readings.stamp_ns[-1]) - start_ns > LOOK_AHEAD_S * NS:
            break
    levels, steps, is_quiet = {}, {}, True
    for name, background in recorder.backgrounds().items():
        assert isinstance(background, BlockRecorder)
        steps[name] = background.steps
        level, had_target = _level_of(
            background, learner.backgrounds()[name].departed_at,
            learnt.get(name)) if name in without_background else (None, False)
        if level is not None \
                and level.n_blocks * level.block_s >= MIN_LEVEL_FRACTION * settings.learn_s:
            levels[name] = level
            is_quiet &= not had_target \
                and _begins_quietly(learnt.get(name), level, background, settings)
    # The field of a target that one sensor detects at the start may be part of the backgrounds of
    # all sensors.
    return Prescan({} if is_quiet else levels, steps,
                   {name: recorder.driver_faults.of(name) for name in network.names})


def _beginning(batches: Iterator[Readings], network: SensorNetwork, settings: CalibrateSettings
               ) -> tuple[list[Readings], dict[str, ReadingFaults]]:
    """First batches, and the faults of the drivers that are visible in them."""
    stage, beginning, n = Calibrate(network, settings), [], 0
    while n < N_BEGINNING * len(network) and (readings := next(batches, None)) is not None:
        stage.feed(readings)
        beginning.append(readings)
        n += len(readings)
    return beginning, {name: stage.driver_faults.of(name) for name in network.names}


def _level_of(recorder: BlockRecorder, departed_at: float | None,
              learnt: tuple[float, FloatArray] | None) -> tuple[MostFrequentLevel | None, bool]:
    """Most frequent level, if any, and whether a target was present at the start: if it departed at
    `departed_at` [s], unless the field later returns to the level `learnt` at the start."""
    level = recorder.quiet_level()
    if level is None or departed_at is None or learnt is None \
            or recorder.has_returned(learnt[1], level, departed_at):
        return level, False
    return recorder.quiet_level(departed_at), True


def _learn(learner: Calibrate, readings: Readings, first_ns: dict[str, int],
           learnt: dict[str, tuple[float, FloatArray]]) -> None:
    """Feed `learner`; update first timestamps, and learning times [s] with backgrounds (3,) [T]."""
    for i in range(0, len(readings), N_READINGS_AT_ONCE):
        if len(learnt) == len(learner.backgrounds()):
            learner.feed(readings.part(slice(i, None)))
            return
        part = readings.part(slice(i, i + N_READINGS_AT_ONCE))
        for name, stamp_ns in zip(part.sensor_names(), part.stamp_ns.tolist(), strict=True):
            first_ns.setdefault(name, stamp_ns)
        learner.feed(part)
        for name, background in learner.backgrounds().items():
            if background.ready and name not in learnt and name in first_ns:
                elapsed_s = (int(part.stamp_ns[-1]) - first_ns[name]) / NS
                learnt[name] = elapsed_s, learner.background(name)


def _begins_quietly(learnt: tuple[float, FloatArray] | None, level: MostFrequentLevel,
                    recorder: BlockRecorder, settings: CalibrateSettings) -> bool:
    """Whether the initial background was learnt early and, with relearning, equals `level`."""
    max_time = LEARNING_TOLERANCE_S + max(settings.learn_s, MIN_BLOCKS * level.block_s)
    if learnt is None or learnt[0] > max_time:
        return False
    # Without relearning, a level remains the background even if another level lasts.
    return not settings.relearn_s or recorder.is_known_level(learnt[1], level)
