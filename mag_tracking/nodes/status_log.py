"""Log of the diagnostics: each fault when it appears, and once a minute while it lasts."""

import re
import time
from collections import Counter

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

REPEATED_S = 60.0
"""[s] Interval at which a fault that lasts is logged again."""
MAX_CORRELATION = 4
"""Lines within that interval that differ in numbers only, as those of many sensors do."""
MAX_FAULTS = 1000
"""Faults that are remembered; more are those of a loop that makes up names."""
_NUMBER = re.compile(r'[\d.]+')


class StatusLog:
    """Logs what a `DiagnosticStatus` warns of, and that it is over."""

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        self._faulty: set[str] = set()
        self._logged: dict[tuple[str, str], float] = {}
        self._alike: Counter[str] = Counter()
        self._alike_since = 0.0

    @property
    def n_remembered(self) -> int:
        """Faults and kinds of lines that are remembered."""
        return len(self._logged) + len(self._alike)

    def note(self, status: DiagnosticStatus) -> None:
        """Log a status, where it is news."""
        subject = str(status.name.rpartition(': ')[2])
        if status.level == DiagnosticStatus.OK:
            if status.name in self._faulty:
                self._faulty.discard(status.name)
                self._log(DiagnosticStatus.OK, f'{subject}: {status.message} again')
            return
        self._faulty.add(status.name)
        # The same fault has other numbers every second.
        fault, now = (status.name, _NUMBER.sub('#', status.message)), time.monotonic()
        if now - self._logged.get(fault, -REPEATED_S) < REPEATED_S:
            return
        if len(self._logged) >= MAX_FAULTS:
            self._logged.clear()
        self._logged[fault] = now
        self._log(status.level, f'{subject}: {status.message}')

    def tell(self, text: str) -> None:
        """Log a line of information."""
        self._log(DiagnosticStatus.OK, text)

    def _log(self, level: bytes, text: str) -> None:
        """Log a line, but of many that are alike only the first."""
        now, pattern = time.monotonic(), _NUMBER.sub('#', text)
        if now - self._alike_since > REPEATED_S or len(self._alike) >= MAX_FAULTS:
            self._alike.clear()
            self._alike_since = now
        self._alike[pattern] += 1
        if self._alike[pattern] > MAX_CORRELATION:
            return
        if self._alike[pattern] == MAX_CORRELATION:
            text += ' (more that are alike are in /diagnostics only)'
        if level == DiagnosticStatus.ERROR:
            self._logger.error(text)
        elif level == DiagnosticStatus.OK:
            self._logger.info(text)
        else:
            self._logger.warning(text)
