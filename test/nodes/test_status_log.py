"""Log of faults: each fault is logged when it begins and when it ends; lasting errors are repeated
at intervals."""

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from mag_tracking.nodes import diagnostics
from mag_tracking.nodes.diagnostics import MAX_FAULTS, REPEAT_INTERVAL_S, StatusLog


class Logger:
    """Stores log lines."""

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
    """f(seconds, level, message): return the lines logged for a status at a time [s]."""
    now, logger = [0.0], Logger()
    monkeypatch.setattr(diagnostics.time, 'monotonic', lambda: now[0])
    statuses = StatusLog(logger)

    def add(seconds, level, message, name='node: mag_1'):
        now[0], logger.lines = seconds, []
        statuses.add(DiagnosticStatus(level=level, name=name, message=message))
        return logger.lines
    add.statuses = statuses
    return add


def test_a_fault_is_logged_at_its_beginning_and_end(log):
    assert log(0.0, DiagnosticStatus.OK, 'running') == []
    assert log(1.0, DiagnosticStatus.ERROR, 'silent for 3 s') == [
        ('error', 'mag_1: silent for 3 s')]
    # The number in the message changes every second.
    assert log(2.0, DiagnosticStatus.ERROR, 'silent for 4 s') == []
    assert log(3.0, DiagnosticStatus.WARN, 'noisy') == [('warning', 'mag_1: noisy')]
    assert log(4.0, DiagnosticStatus.OK, 'running') == [('info', 'mag_1: running again')]
    assert log(5.0, DiagnosticStatus.OK, 'running') == []


def test_a_lasting_or_intermittent_fault_is_logged_once_a_minute(log):
    times = [k for k in range(1, 200) if any(
        level == 'error' for level, _ in log(float(k), DiagnosticStatus.ERROR if k % 3
                                             else DiagnosticStatus.OK, f'silent for {k} s'))]
    assert times[0] == 1 and len(times) == 4
    assert all(b - a >= REPEAT_INTERVAL_S for a, b in zip(times, times[1:], strict=False))


def test_a_warning_is_logged_once_per_outage(log):
    """A node without input warns once, however long the outage lasts."""
    def warnings(begin, end):
        return [k for k in range(begin, end) for level, _ in log(
            float(k), DiagnosticStatus.WARN, f'no message from detection for {k - begin + 3} s')
            if level == 'warning']
    assert warnings(3, 600) == [3]
    assert log(600.0, DiagnosticStatus.OK, 'running') == [('info', 'mag_1: running again')]
    assert warnings(603, 610) == [603]
    assert len(log(610.0, DiagnosticStatus.OK, 'running')) == 1
    # Frequent outages are logged once a minute; an outage that lasts is always logged.
    assert warnings(620, 900) == [603 + REPEAT_INTERVAL_S]


def test_the_number_of_stored_faults_is_bounded(log):
    for k in range(2 * MAX_FAULTS):
        log(0.0, DiagnosticStatus.WARN, 'bad', f'node: {"x" * (k % 97)}{"y" * (k // 97)}')
    assert log.statuses.n_stored <= 3 * MAX_FAULTS


def test_a_hundred_sensors_with_one_fault_do_not_fill_the_log(log):
    lines = [line for j in range(100) for line in log(
        0.0, DiagnosticStatus.ERROR, f'no message on /mag_{j}/imu/mag', f'node: mag_{j}')]
    assert len(lines) == diagnostics.MAX_SIMILAR_LINES
    assert lines[0] == ('error', 'mag_0: no message on /mag_0/imu/mag')
    assert lines[-1][1].endswith('/diagnostics)')
    lines = [line for j in range(100) for line in log(
        1.0, DiagnosticStatus.OK, 'running', f'node: mag_{j}')]
    assert len(lines) == diagnostics.MAX_SIMILAR_LINES
    # A different fault is still logged; the first fault is logged again in the next minute.
    assert log(2.0, DiagnosticStatus.WARN, 'noisy', 'node: mag_7') == [('warning', 'mag_7: noisy')]
    assert log(2.0 * REPEAT_INTERVAL_S, DiagnosticStatus.ERROR, 'no message on /mag_7/imu/mag',
               'node: mag_7')
