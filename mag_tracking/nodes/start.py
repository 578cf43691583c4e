"""Entry points of the nodes, with signal handling before any slow import.

As soon as this module runs, SIGINT and SIGTERM end the process with status 0: at once during
imports, later through `middleware.main`. A node that is run as a module calls its command first.
"""

import signal
import sys
from functools import partial
from importlib import import_module
from typing import NoReturn

from mag_tracking.interrupts import exit_on_signals

END_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a node."""


def run_node(name: str) -> NoReturn:
    """Run a node, named by its module, as a process; does not return."""
    status = 1
    try:
        with exit_on_signals(0, *END_SIGNALS):
            status = import_module(f'mag_tracking.nodes.{name}').main()
    except KeyboardInterrupt:
        status = 130
    finally:
        # Finalisation of Python also takes time; further signals are ignored.
        for s in END_SIGNALS:
            signal.signal(s, signal.SIG_IGN)
        limit_exit_time(status)
    sys.exit(status)


def limit_exit_time(status: int) -> None:
    """Limit the time until the process ends with `status`, if the process has imported rclpy."""
    if 'rclpy' in sys.modules:
        import_module('mag_tracking.nodes.middleware').limit_exit_time(status)


driver_node, replay_node, calibration_node, detection_node, tracker_node = (
    partial(run_node, name) for name in (
        'driver_node', 'replay_node', 'calibration_node', 'detection_node', 'tracker_node'))
"""Commands of the same names."""
