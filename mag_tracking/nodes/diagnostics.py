"""Diagnostics of the nodes: their log, in which each fault appears when it begins and when it ends.

Lasting errors are repeated at intervals.
"""

import re
import time
from collections import Counter

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

REPEAT_INTERVAL_S = 60.0
"""[s] Minimum interval between log lines of one fault; a persistent error is repeated
after this interval."""
MAX_SIMILAR_LINES = 4
"""Maximum number of lines per interval that differ only in numbers, such as sensor numbers."""
MAX_FAULTS = 1000
"""Maximum number of stored faults; limits the memory if names are generated without limit."""
_NUMBER = re.compile(r'[\d.]+')


class StatusLog:
    """Logs the beginning and the end of faults in `DiagnosticStatus` messages."""

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        self._faulty_names: set[str] = set()
        # Last logged fault of each name whose status has not been OK since.
        self._current_faults: dict[str, tuple[str, str]] = {}
        self._last_logged: dict[tuple[str, str], float] = {}
        self._similar: Counter[str] = Counter()
        self._interval_start = 0.0

    @property
    def n_stored(self) -> int:
        """Number of stored faults and line patterns."""
        return len(self._last_logged) + len(self._current_faults) + len(self._similar)

    def add(self, status: DiagnosticStatus) -> None:
        """Log a status if its fault is new or has ended, or if an error is due to be repeated."""
        subject = str(status.name.rpartition(': ')[2])
        if status.level == DiagnosticStatus.OK:
            self._current_faults.pop(status.name, None)
            if status.name in self._faulty_names:
                self._faulty_names.discard(status.name)
                self._log(DiagnosticStatus.OK, f'{subject}: {status.message} again')
            return
        self._faulty_names.add(status.name)
        # The numbers in the message of a persistent fault change every second.
        fault, now = (status.name, _NUMBER.sub('#', status.message)), time.monotonic()
        if now - self._last_logged.get(fault, -REPEAT_INTERVAL_S) < REPEAT_INTERVAL_S:
            return
        if status.level != DiagnosticStatus.ERROR \
                and self._current_faults.get(status.name) == fault:
            return
        if len(self._last_logged) >= MAX_FAULTS:
            self._last_logged.clear()
            self._current_faults.clear()
        self._last_logged[fault] = now
        self._current_faults[status.name] = fault
        self._log(status.level, f'{subject}: {status.message}')

    def info(self, text: str) -> None:
        """Log a line at level INFO."""
        self._log(DiagnosticStatus.OK, text)

    def _log(self, level: bytes, text: str) -> None:
        """Log a line unless the current interval already has `MAX_SIMILAR_LINES` similar lines."""
        now, pattern = time.monotonic(), _NUMBER.sub('#', text)
        if now - self._interval_start > REPEAT_INTERVAL_S or len(self._similar) >= MAX_FAULTS:
            self._similar.clear()
            self._interval_start = now
        self._similar[pattern] += 1
        if self._similar[pattern] > MAX_SIMILAR_LINES:
            return
        if self._similar[pattern] == MAX_SIMILAR_LINES:
            text += ' (further similar messages appear only in /diagnostics)'
        if level == DiagnosticStatus.ERROR:
            self._logger.error(text)
        elif level == DiagnosticStatus.OK:
            self._logger.info(text)
        else:
            self._logger.warning(text)
