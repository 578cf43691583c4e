"""Diagnostics of the nodes, and their log, in which a fault appears when it begins and ends."""

import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
REPEAT_INTERVAL_S = 60.0
"""[s] Interval after which a persistent error is logged again."""
MAX_SIMILAR_LINES = 4
"""Maximum number of lines per interval that differ only in numbers, such as sensor numbers."""
MAX_FAULTS = 1000
"""Maximum number of stored faults; limits the memory if names are generated without limit."""
_NUMBER = re.compile(r'[\d.]+')


def status_of(name: str, message: str, level: bytes = OK,
              values: Mapping[str, object] | None = None,
              hardware: str = 'magnetometer network') -> DiagnosticStatus:
    """Create a diagnostic status."""
    return DiagnosticStatus(
        level=level, name=name, hardware_id=hardware, message=message,
        values=[KeyValue(key=k, value=str(v)) for k, v in (values or {}).items()])


class DiagnosticsPublisher:
    """Publishes statuses on /diagnostics and logs faults; `title` names the node."""

    def __init__(self, node: Node) -> None:
        self._node, self.log = node, StatusLog(node.get_logger())
        self.title = node.get_fully_qualified_name().removeprefix('/')
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, statuses: Sequence[DiagnosticStatus]) -> None:
        """Log and publish statuses."""
        for status in statuses:
            self.log.add(status)
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


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
        if status.level == OK:
            self._current_faults.pop(status.name, None)
            if status.name in self._faulty_names:
                self._faulty_names.discard(status.name)
                self._log(OK, f'{subject}: {status.message} again')
            return
        self._faulty_names.add(status.name)
        # The numbers in the message of a persistent fault change every second.
        fault, now = (status.name, _NUMBER.sub('#', status.message)), time.monotonic()
        if now - self._last_logged.get(fault, -REPEAT_INTERVAL_S) < REPEAT_INTERVAL_S:
            return
        if status.level != ERROR and self._current_faults.get(status.name) == fault:
            return
        if len(self._last_logged) >= MAX_FAULTS:
            self._last_logged.clear()
            self._current_faults.clear()
        self._last_logged[fault] = now
        self._current_faults[status.name] = fault
        self._log(status.level, f'{subject}: {status.message}')

    def info(self, text: str) -> None:
        """Log a line at level INFO."""
        self._log(OK, text)

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
        # rclpy does not allow one line of code to log at several levels.
        if level == ERROR:
            self._logger.error(text)
        elif level == OK:
            self._logger.info(text)
        else:
            self._logger.warning(text)
