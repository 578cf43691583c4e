"""Diagnostics of the drivers."""

from collections.abc import Collection, Sequence

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from mag_tracking.drivers.driver import Driver
from mag_tracking.nodes.stage_node import title_of
from mag_tracking.nodes.status_log import StatusLog

EXPECTED_COUNTS = ('samples: ', 'late arrivals: ', 'other messages: ', 'lines that are comments',
                   'lines without the prefix', 'lines that are empty', 'retained messages skipped',
                   'conversions overwritten', 'packets not used')
"""Prefixes of counts that are reported but do not cause a warning."""


class DriverDiagnostics:
    """Reports the state of each device and logs changes."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reported_counts: dict[str, dict[str, int]] = {}
        self._log = StatusLog(node.get_logger())

    def statuses(self, drivers: Sequence[Driver], running: Collection[str],
                 active: bool) -> list[DiagnosticStatus]:
        """Return one status per driver and log changes; `running` are those with a live thread."""
        return [self._status(driver, driver.name in running, active) for driver in drivers]

    def _status(self, driver: Driver, running: bool, active: bool) -> DiagnosticStatus:
        """Return the diagnostics of one device, and log a change."""
        counts = driver.counts()
        previous = self._reported_counts.get(driver.name, {})
        examples = driver.examples()
        increases = [f'{count}: {n - previous.get(count, 0)} more'
                     + (f', such as {examples[count]}' if count in examples else '')
                     for count, n in sorted(counts.items())
                     if n > previous.get(count, 0) and not count.startswith(EXPECTED_COUNTS)]
        self._reported_counts[driver.name] = dict(counts)
        level, message = DiagnosticStatus.OK, 'open'
        if not active:
            message = 'not active'
        elif not running:
            level, message = DiagnosticStatus.ERROR, 'the driver thread has ended: restart the node'
        elif driver.fault:
            level, message = DiagnosticStatus.ERROR, driver.fault
        elif not driver.is_open:
            # No fault has occurred, and opening some devices takes seconds.
            message = 'opening'
        elif increases:
            level, message = DiagnosticStatus.WARN, '; '.join(increases)
        values = {count: str(n) for count, n in sorted(counts.items())}
        for source, clock in driver.clocks().items():
            suffix = f' ({source})' if source else ''
            values[f'clock drift [ppm]{suffix}'] = f'{clock.drift_ppm:.2f}'
            values[f'delay above the minimum, 95 % [ms]{suffix}'] = f'{1e3 * clock.spread_s:.3g}'
            values[f'timestamp std [ms]{suffix}'] = f'{1e3 * clock.stamp_std:.3g}'
        status = DiagnosticStatus(
            level=level, name=f'{title_of(self._node)}: {driver.name}', hardware_id=driver.name,
            message=message, values=[KeyValue(key=k, value=v) for k, v in values.items()])
        self._log.add(status)
        return status
