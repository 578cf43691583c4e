"""Storage of learnt backgrounds in a file, from which a restarted node restores them."""

import time
from collections.abc import Iterable
from pathlib import Path

from rclpy.impl.rcutils_logger import RcutilsLogger

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.background_file import (
    background_text,
    read_backgrounds,
    write_backgrounds,
)
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.stage import Calibrate

WRITE_INTERVAL_S = 5.0
"""[s] Interval between writes, unless a quarter of `calibrate.max_resume_gap_s` is shorter."""


class BackgroundStore:
    """Stores the current background of each sensor in a file; a `path` of None disables storage."""

    def __init__(self, path: Path | None, stage: Calibrate, settings: CalibrateSettings,
                 logger: RcutilsLogger) -> None:
        self._path, self._stage, self._settings = path, stage, settings
        self._logger = logger
        self._entries: dict[str, str] = {}
        self._written_sensors: frozenset[str] = frozenset()
        self._next_write = 0.0

    def restore(self, network: SensorNetwork) -> None:
        """Pass the stored backgrounds to the stage, to be used from each sensor's first reading.

        Outdated backgrounds are not restored; invalid backgrounds are logged.
        """
        if self._path is None:
            return
        try:
            restored, rejected = read_backgrounds(self._path, network, self._settings)
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
        """Update the stored background of sensor `j`; remove it if it is unknown or doubtful.

        The file is not written until the next `write_if_due`.
        """
        name = network.names[j]
        background = None if self._path is None else self._stage.stored(name)
        if background is None:
            self._entries.pop(name, None)
        else:
            self._entries[name] = background_text(background, network, j, self._settings)

    def write_if_due(self, is_live: bool) -> None:
        """Write the file if the interval has elapsed or it lacks a sensor; log a failure.

        During a replay, nothing is written.
        """
        now = time.monotonic()
        has_new_sensor = not self._entries.keys() <= self._written_sensors
        if self._path is None or not is_live or now < self._next_write and not has_new_sensor:
            return
        self._next_write = now + min(WRITE_INTERVAL_S, self._settings.max_resume_gap_s / 4.0)
        try:
            write_backgrounds(self._path, self._entries)
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
