"""Backgrounds of a calibration, stored in a file so that a restarted node restores them."""

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

WRITE_EVERY_S = 5.0
"""[s] Interval of writing; shorter where `calibrate.max_resume_gap_s` is short."""


class BackgroundStore:
    """Stores the background of each sensor that is known; without a path it does nothing."""

    def __init__(self, path: Path | None, stage: Calibrate, settings: CalibrateSettings,
                 logger: RcutilsLogger) -> None:
        self._path, self._stage, self._settings = path, stage, settings
        self._logger = logger
        self._texts: dict[str, str] = {}
        self._written: frozenset[str] = frozenset()
        self._next_write = 0.0

    def restore(self, network: SensorNetwork) -> None:
        """Offer the stored backgrounds to the stage; the first readings decide on their use."""
        if self._path is None:
            return
        try:
            kept, refused = read_backgrounds(self._path, network, self._settings)
        except RecordingError as error:
            self._logger.warning(f'what was learnt before is not used: {error}')
            return
        for name, why in refused.items():
            self._logger.warning(f'what was learnt of {name} before is not used: {why}')
        self._stage.resume(kept)
        if kept:
            self._logger.info(
                f'goes on with the backgrounds of {", ".join(kept)}, where their readings go on '
                f'within {self._settings.max_resume_gap_s:g} s; ~/calibrate learns anew')

    def update(self, network: SensorNetwork, j: int) -> None:
        """Take the present background of sensor `j`, if it is known."""
        name = network.names[j]
        kept = None if self._path is None else self._stage.stored(name)
        if kept is None:
            self._texts.pop(name, None)
        else:
            self._texts[name] = background_text(kept, network, j, self._settings)

    def write_if_due(self, is_live: bool) -> None:
        """Write the file if it is time to, and the readings are live, not of a recording.

        A background that has only now become known is not left to the next interval.
        """
        now = time.monotonic()
        is_new = not self._texts.keys() <= self._written
        if self._path is None or not is_live or now < self._next_write and not is_new:
            return
        self._next_write = now + min(WRITE_EVERY_S, self._settings.max_resume_gap_s / 4.0)
        try:
            write_backgrounds(self._path, self._texts)
            self._written = frozenset(self._texts)
        except OutputError as error:
            self._logger.warning(f'backgrounds are not kept for a restart: {error}',
                                 throttle_duration_sec=60.0)

    def drop(self, sensors: Iterable[str], is_live: bool) -> None:
        """Remove `sensors` from the file."""
        for name in sensors:
            self._texts.pop(name, None)
        self._next_write = 0.0
        self.write_if_due(is_live)
