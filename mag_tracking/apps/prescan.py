"""A first pass over a recording: the quiet stretches of sensors that have no quiet beginning."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.frequent_level import QuietLevel
from mag_tracking.calibration.quiet_level import BlockRecorder
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.units import NS

PATIENCE_S = 1.0
"""[s] A beginning is quiet where the background is known so long after the shortest time."""

FEWEST_BLOCKS = 6.0
"""The shortest time of a slow sensor, whose blocks are longer."""

LEAST = 1.0 / 3.0
"""A level is a background where it was seen for this share of the usual time, in all."""

FEW = 8
"""Readings that are fed at once while the beginning is learnt."""


@dataclass(frozen=True)
class Prescan:
    """Backgrounds and steps that a first pass over a recording found."""

    levels: dict[str, QuietLevel]
    """{sensor: most frequent level}; empty where the beginning is quiet."""
    steps: dict[str, FloatArray]
    """{sensor: (3,) [T] smallest change of each axis}."""

    def segment_of(self, sensor: str) -> list[float] | None:
        """[begin, end] of the stretch of its background, in s after its first reading, or None."""
        level = self.levels.get(sensor)
        return None if level is None else [level.begin, level.end]

    def apply(self, calibrate: Calibrate) -> None:
        """Begin a calibration with what was found."""
        calibrate.start_from(self.levels, self.steps)


def prescan(batches: Iterable[Readings], network: SensorNetwork,
               settings: CalibrateSettings) -> Prescan:
    """Find the backgrounds of sensors whose recording begins with a target.

    Parameters
    ----------
    batches : iterable of Readings
        Raw, from the beginning of the recording; read up to `look_ahead_s`.
    network : SensorNetwork
    settings : CalibrateSettings

    Returns
    -------
    Prescan
        Empty where the network file has all backgrounds, or `look_ahead_s` is 0.
    """
    wanted = [name for name, level in zip(network.names, network.background, strict=True)
              if level is None]
    if not wanted or not settings.look_ahead_s:
        return Prescan({}, {})
    recorder, learner = Calibrate(network, settings, BlockRecorder), Calibrate(network, settings)
    first_ns: dict[str, int] = {}
    learnt: dict[str, tuple[float, FloatArray]] = {}
    for readings in batches:
        recorder.feed(readings)
        _learn(learner, readings, first_ns, learnt)
        start_ns = min(first_ns.values(), default=0)
        if len(readings) and int(readings.stamp_ns[-1]) - start_ns > settings.look_ahead_s * NS:
            break
    found, steps, is_quiet = {}, {}, True
    for name, background in recorder.backgrounds().items():
        assert isinstance(background, BlockRecorder)
        steps[name] = background.steps
        level, was_freed = _level_of(background, learner.backgrounds()[name].departed_at,
                                     learnt.get(name)) if name in wanted else (None, False)
        if level is not None and level.n_blocks * level.block_s >= LEAST * settings.learn_s:
            found[name] = level
            is_quiet &= not was_freed \
                and _begins_quietly(learnt.get(name), level, background, settings)
    # A target that one sensor feels at the beginning may be in the background of all.
    return Prescan({} if is_quiet else found, steps)


def _level_of(recorder: BlockRecorder, departed_at: float | None,
              learnt: tuple[float, FloatArray] | None) -> tuple[QuietLevel | None, bool]:
    """Most frequent level of a sensor, and whether something stood there until `departed_at` [s].

    It had not where the level of the beginning, as it was `learnt`, comes back.
    """
    level = recorder.quiet_level()
    if level is None or departed_at is None or learnt is None \
            or recorder.has_returned(learnt[1], level, departed_at):
        return level, False
    return recorder.quiet_level(departed_at), True


def _learn(learner: Calibrate, readings: Readings, first_ns: dict[str, int],
           learnt: dict[str, tuple[float, FloatArray]]) -> None:
    """Note the first reading of each sensor, and when its background is known.

    `learnt` {sensor: (seconds after its first reading, (3,) [T])} and `first_ns` {sensor: [ns]}
    are changed.
    """
    for i in range(0, len(readings), FEW):
        if len(learnt) == len(learner.backgrounds()):
            learner.feed(readings.part(slice(i, None)))
            return
        part = readings.part(slice(i, i + FEW))
        for name, stamp_ns in zip(part.sensor_names(), part.stamp_ns.tolist(), strict=True):
            first_ns.setdefault(name, stamp_ns)
        learner.feed(part)
        for name, background in learner.backgrounds().items():
            if background.ready and name not in learnt and name in first_ns:
                since = (int(part.stamp_ns[-1]) - first_ns[name]) / NS
                learnt[name] = since, learner.background(name)


def _begins_quietly(learnt: tuple[float, FloatArray] | None, found: QuietLevel,
                    recorder: BlockRecorder, settings: CalibrateSettings) -> bool:
    """Whether a sensor's background was known early, and is the one that it has."""
    longest = PATIENCE_S + max(settings.learn_s, FEWEST_BLOCKS * found.block_s)
    if learnt is None or learnt[0] > longest:
        return False
    # Without relearning, a level stays the background whatever else lasts.
    return not settings.relearn_s or recorder.is_known_level(learnt[1], found)


def prescan_of(recording: Recording, network: SensorNetwork, settings: CalibrateSettings,
                  stopped: Callable[[], bool] | None = None) -> Prescan:
    """`prescan` over a recording; when `stopped` returns true it ends with what it has.

    Raises
    ------
    RecordingError
        If the recording has none of the network's topics.
    """
    # What is lost or rejected is counted when the recording is read for its readings.
    reader = SampleReader(Recording(recording.path), network)

    def batches() -> Iterator[Readings]:
        try:
            yield from until_stopped(reader.readings, None, stopped)
        except ReadingStopped:
            return

    return prescan(batches(), network, settings)
