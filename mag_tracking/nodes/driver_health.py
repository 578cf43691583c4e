"""The health of the drivers as diagnostics."""

from collections.abc import Collection, Sequence

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from mag_tracking.drivers.driver import Driver
from mag_tracking.nodes.stage_node import title_of
from mag_tracking.nodes.status_log import StatusLog

HARMLESS = ('samples: ', 'late arrivals: ', 'other messages: ', 'lines that are comments',
            'lines without the prefix', 'lines that are empty', 'retained messages skipped',
            'conversions overwritten', 'packets not used')
"""What begins so is counted, but nothing to be warned of."""


class DriverDiagnostics:
    """Says how each device is, and logs when that changes."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reported: dict[str, dict[str, int]] = {}
        self._log = StatusLog(node.get_logger())

    def statuses(self, drivers: Sequence[Driver], served: Collection[str],
                 active: bool) -> list[DiagnosticStatus]:
        """[DiagnosticStatus], one a device; `served` are the names of those with a thread."""
        return [self._status(driver, driver.name in served, active) for driver in drivers]

    def _status(self, driver: Driver, served: bool, active: bool) -> DiagnosticStatus:
        """The DiagnosticStatus of one device."""
        counts = driver.counts()
        before = self._reported.get(driver.name, {})
        news = [f'{what}: {n - before.get(what, 0)} more' for what, n in sorted(counts.items())
                if n > before.get(what, 0) and not what.startswith(HARMLESS)]
        self._reported[driver.name] = dict(counts)
        level, message = DiagnosticStatus.OK, 'open'
        if not active:
            message = 'not active'
        elif not served:
            level, message = DiagnosticStatus.ERROR, 'its thread has ended: start the node again'
        elif driver.fault:
            level, message = DiagnosticStatus.ERROR, driver.fault
        elif not driver.is_open:
            # It has no trouble, and some devices take seconds.
            message = 'opening'
        elif news:
            level, message = DiagnosticStatus.WARN, '; '.join(news)
        values = {what: str(n) for what, n in sorted(counts.items())}
        for source, clock in driver.clocks().items():
            behind = f' ({source})' if source else ''
            values[f'drift of its clock [ppm]{behind}'] = f'{clock.drift_ppm:.2f}'
            values[f'messages behind the quickest [ms]{behind}'] = f'{1e3 * clock.spread_s:.3g}'
            values[f'std of its stamps [ms]{behind}'] = f'{1e3 * clock.stamp_std:.3g}'
        status = DiagnosticStatus(
            level=level, name=f'{title_of(self._node)}: {driver.name}', hardware_id=driver.name,
            message=message, values=[KeyValue(key=k, value=v) for k, v in values.items()])
        self._log.note(status)
        return status
