"""Periodic work, one sensor after another: health, calibration state, stored background."""

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from mag_tracking_msgs.msg import SensorCalibration
from rclpy.impl.rcutils_logger import RcutilsLogger

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.messages.network import sensor_dict
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.sensor_health import HealthDiagnostics
from mag_tracking.recording import background_file
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings

WRITE_INTERVAL_S = 5.0
"""[s] Interval between writes, unless a quarter of `calibrate.max_resume_gap_s` is shorter."""


class BackgroundStore:
    """Stores the current background of each sensor in a file; a `path` of None disables storage."""

    def __init__(self, path: Path | None, stage: Calibrate, settings: CalibrateSettings,
                 logger: RcutilsLogger) -> None:
        self._path, self._stage, self._settings, self._logger = path, stage, settings, logger
        self._entries: dict[str, str] = {}
        self._written_sensors: frozenset[str] = frozenset()
        self._next_write = 0.0

    def restore(self, network: SensorNetwork) -> None:
        """Pass the stored backgrounds, except outdated ones, to the stage; log invalid ones."""
        if self._path is None:
            return
        try:
            restored, rejected = background_file.read_backgrounds(
                self._path, network, self._settings)
        except RecordingError as error:
            self._logger.warning(f'stored backgrounds are not used: {error}')
            return
        for name, reason in rejected.items():
            self._logger.warning(f'{name}: the stored background is not used: {reason}')
        self._stage.resume(restored)
        if restored:
            self._logger.info(
                f'the stored backgrounds of {", ".join(restored)} are used if the readings '
                f'resume within {self._settings.max_resume_gap_s:g} s; call ~/calibrate to learn '
                'the backgrounds again')

    def update(self, network: SensorNetwork, j: int) -> None:
        """Update the entry of sensor `j`; remove it if its background is unknown or doubtful."""
        name = network.names[j]
        background = None if self._path is None else self._stage.stored(name)
        if background is None:
            self._entries.pop(name, None)
        else:
            self._entries[name] = background_file.background_text(
                background, network, j, self._settings)

    def write_if_due(self, is_live: bool) -> None:
        """Write the file, unless during a replay, if it lacks a sensor or the interval is over."""
        now = time.monotonic()
        has_new_sensor = not self._entries.keys() <= self._written_sensors
        if self._path is None or not is_live or now < self._next_write and not has_new_sensor:
            return
        self._next_write = now + min(WRITE_INTERVAL_S, self._settings.max_resume_gap_s / 4.0)
        try:
            background_file.write_backgrounds(self._path, self._entries)
            self._written_sensors = frozenset(self._entries)
        except OutputError as error:
            self._logger.warning(f'backgrounds cannot be stored for a restart: {error}',
                                 throttle_duration_sec=60.0)

    def drop(self, sensors: Iterable[str], is_live: bool) -> None:
        """Remove the backgrounds of sensors; write the file at once unless during a replay."""
        for name in sensors:
            self._entries.pop(name, None)
        self._next_write = 0.0
        self.write_if_due(is_live)


class SensorRounds:
    """Processes the sensors one after another, in steps of similar duration; `publish_states` is
    called with the calibration of all sensors, a list that is reused."""

    def __init__(self, node: str, network: SensorNetwork, stage: Calibrate,
                 health: HealthDiagnostics, store: BackgroundStore, is_live: Callable[[], bool],
                 publish_status: Callable[[DiagnosticStatus], None],
                 publish_states: Callable[[list[SensorCalibration]], None]) -> None:
        self._node, self._stage, self._health, self._store = node, stage, health, store
        self._is_live = is_live
        self._publish_status, self._publish_states = publish_status, publish_states
        self._is_step_due = False
        self._reported_doubts: set[tuple[int, tuple[int, int | None]]] = set()
        self.begin(network)

    def begin(self, network: SensorNetwork) -> None:
        """Begin a new round with a network, which replaces the previous one."""
        self._network = network
        self._steps = self._rounds()
        self._states = [self._state(j) for j in range(len(network))]

    def tick(self) -> None:
        """Make the next step due after the next readings; if a step is still due, run it first."""
        self.step_if_due()
        self._is_step_due = True

    def step_if_due(self) -> None:
        """Run the next step of the round if it is due."""
        if self._is_step_due:
            self._is_step_due = False
            next(self._steps)

    def report_doubts(self) -> None:
        """Publish the calibration at once if a background becomes or ceases to be doubtful,
        because the tracker flags tracks as ambiguous only after it has received it."""
        latest_doubts = {(j, doubt) for j, name in enumerate(self._network.names)
                         if (doubt := self._stage.latest_doubt(name)) is not None}
        if changed := latest_doubts - self._reported_doubts:
            for j, _ in changed:
                self._states[j] = self._state(j)
            self.publish()
        self._reported_doubts = latest_doubts

    def publish(self) -> None:
        """Publish the latest calibration of all sensors."""
        self._publish_states(self._states)

    def _state(self, j: int) -> SensorCalibration:
        """Return the current calibration of sensor `j` as a message."""
        return to_message(SensorCalibration, sensor_dict(self._stage, self._network, j))

    def _rounds(self) -> Iterator[None]:
        """Run endless rounds over the sensors; yield after each step."""
        while True:
            self._health.begin_round(self._stage)
            yield
            for j in range(len(self._network)):
                self._health.update(j)
                self._states[j] = self._state(j)
                self._store.update(self._network, j)
                yield
                self._publish_status(self._health.status(self._node, j, self._stage))
                yield
            self.publish()
            yield
            self._store.write_if_due(self._is_live())
            yield
