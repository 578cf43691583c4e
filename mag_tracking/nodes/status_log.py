"""Log of the diagnostics: each fault when it appears, and once a minute while it lasts."""

import re
import time
from collections import Counter

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

REPEAT_INTERVAL_S = 60.0
"""[s] Interval at which a lasting fault is logged again."""
MAX_SIMILAR_LINES = 4
"""Maximum number of lines within that interval that differ in numbers only, as for many sensors."""
MAX_FAULTS = 1000
"""Maximum number of faults remembered; more than that come from names generated without limit."""
_NUMBER = re.compile(r'[\d.]+')


class StatusLog:
    """Logs faults from `DiagnosticStatus` messages, and their end.

    Parameters
    ----------
    logger : RcutilsLogger
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        self._faulty: set[str] = set()
        self._logged: dict[tuple[str, str], float] = {}
        self._similar: Counter[str] = Counter()
        self._similar_since = 0.0

    @property
    def n_remembered(self) -> int:
        """Number of faults and kinds of lines that are remembered."""
        return len(self._logged) + len(self._similar)

    def add(self, status: DiagnosticStatus) -> None:
        """Log a status if it is new.

        Parameters
        ----------
        status : DiagnosticStatus
        """
        subject = str(status.name.rpartition(': ')[2])
        if status.level == DiagnosticStatus.OK:
            if status.name in self._faulty:
                self._faulty.discard(status.name)
                self._log(DiagnosticStatus.OK, f'{subject}: {status.message} again')
            return
        self._faulty.add(status.name)
        # The numbers in the message of a lasting fault change every second.
        fault, now = (status.name, _NUMBER.sub('#', status.message)), time.monotonic()
        if now - self._logged.get(fault, -REPEAT_INTERVAL_S) < REPEAT_INTERVAL_S:
            return
        if len(self._logged) >= MAX_FAULTS:
            self._logged.clear()
        self._logged[fault] = now
        self._log(status.level, f'{subject}: {status.message}')

    def info(self, text: str) -> None:
        """Log a line at level INFO.

        Parameters
        ----------
        text : str
        """
        self._log(DiagnosticStatus.OK, text)

    def _log(self, level: bytes, text: str) -> None:
        """Log a line; of many similar ones, only the first."""
        now, pattern = time.monotonic(), _NUMBER.sub('#', text)
        if now - self._similar_since > REPEAT_INTERVAL_S or len(self._similar) >= MAX_FAULTS:
            self._similar.clear()
            self._similar_since = now
        self._similar[pattern] += 1
        if self._similar[pattern] > MAX_SIMILAR_LINES:
            return
        if self._similar[pattern] == MAX_SIMILAR_LINES:
            text += ' (further similar messages are in /diagnostics only)'
        if level == DiagnosticStatus.ERROR:
            self._logger.error(text)
        elif level == DiagnosticStatus.OK:
            self._logger.info(text)
        else:
            self._logger.warning(text)
