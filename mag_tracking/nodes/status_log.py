"""Diagnostics in the log: each fault when it appears, and again while it lasts."""

import re
import time

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

REPEATED_S = 60.0
"""[s] Interval at which a fault that lasts is logged again."""
MOST_FAULTS = 1000
"""Faults that are remembered; more are those of a loop that makes up names."""
_NUMBER = re.compile(r'[\d.]+')


class StatusLog:
    """Logs what a `DiagnosticStatus` warns of, and that it is over."""

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        self._faulty: set[str] = set()
        self._logged: dict[tuple[str, str], float] = {}

    def note(self, status: DiagnosticStatus) -> None:
        """Log a status, where it is news."""
        if status.level == DiagnosticStatus.OK:
            if status.name in self._faulty:
                self._faulty.discard(status.name)
                self._logger.info(f'{_subject(status)}: {status.message} again')
            return
        self._faulty.add(status.name)
        # The same fault has other numbers every second.
        fault, now = (status.name, _NUMBER.sub('#', status.message)), time.monotonic()
        if now - self._logged.get(fault, -REPEATED_S) < REPEATED_S:
            return
        if len(self._logged) >= MOST_FAULTS:
            self._logged.clear()
        self._logged[fault] = now
        text = f'{_subject(status)}: {status.message}'
        if status.level == DiagnosticStatus.ERROR:
            self._logger.error(text)
        else:
            self._logger.warning(text)


def _subject(status: DiagnosticStatus) -> str:
    """What a status is of: the logger names the node."""
    return str(status.name.rpartition(': ')[2])
