"""Faults in the log: when they appear, now and then while they last, and when they are over."""

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from mag_tracking.nodes import status_log
from mag_tracking.nodes.status_log import MOST_FAULTS, REPEATED_S, StatusLog


class Logger:
    """Keeps what is logged."""

    def __init__(self):
        self.lines = []

    def info(self, text):
        self.lines.append(('info', text))

    def warning(self, text):
        self.lines.append(('warning', text))

    def error(self, text):
        self.lines.append(('error', text))


@pytest.fixture
def log(monkeypatch):
    """f(seconds, level, message): what is logged of a status of that time."""
    now, logger = [0.0], Logger()
    monkeypatch.setattr(status_log.time, 'monotonic', lambda: now[0])
    statuses = StatusLog(logger)

    def note(seconds, level, message, name='node: mag_1'):
        now[0], logger.lines = seconds, []
        statuses.note(DiagnosticStatus(level=level, name=name, message=message))
        return logger.lines
    return note


def test_a_fault_is_told_when_it_appears_and_when_it_is_over(log):
    assert log(0.0, DiagnosticStatus.OK, 'running') == []
    assert log(1.0, DiagnosticStatus.ERROR, 'silent for 3 s') == [
        ('error', 'mag_1: silent for 3 s')]
    # Its numbers change every second.
    assert log(2.0, DiagnosticStatus.ERROR, 'silent for 4 s') == []
    assert log(3.0, DiagnosticStatus.WARN, 'noisy') == [('warning', 'mag_1: noisy')]
    assert log(4.0, DiagnosticStatus.OK, 'running') == [('info', 'mag_1: running again')]
    assert log(5.0, DiagnosticStatus.OK, 'running') == []


def test_a_fault_that_lasts_or_flickers_is_told_once_a_minute(log):
    told = [k for k in range(1, 200) if any(
        level == 'error' for level, _ in log(float(k), DiagnosticStatus.ERROR if k % 3
                                             else DiagnosticStatus.OK, f'silent for {k} s'))]
    assert told == [1, *(k for k in told[1:])] and len(told) == 4
    assert all(b - a >= REPEATED_S for a, b in zip(told, told[1:], strict=False))


def test_memory_is_bounded(log):
    for k in range(2 * MOST_FAULTS):
        assert log(0.0, DiagnosticStatus.WARN, 'bad', f'node: {"x" * (k % 97)}{k}')
