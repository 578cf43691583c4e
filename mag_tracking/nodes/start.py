"""Entry points of the nodes: signals are handled before anything that takes time is imported.

The imports of a node take a second, on a small computer several. From the first line here on,
SIGINT and SIGTERM end the process with status 0: at once while modules are imported, and later by
`stage_node.main`, which lets the node leave the middleware. What comes before, the start of Python
itself, is out of reach.
"""

import signal
import sys
from importlib import import_module
from typing import NoReturn

from mag_tracking.interrupts import exit_on_signals

ENDING = (signal.SIGINT, signal.SIGTERM)
"""The signals that end a node."""


def run_node(name: str) -> NoReturn:
    """Run the node of the module `name` as a process; does not return."""
    status = 1
    try:
        with exit_on_signals(0, *ENDING):
            status = import_module(f'mag_tracking.nodes.{name}').main()
    except KeyboardInterrupt:
        status = 130
    finally:
        # The end of Python takes a while, too: a second signal is ignored.
        for s in ENDING:
            signal.signal(s, signal.SIG_IGN)
        limit_exit_time(status)
    sys.exit(status)


def limit_exit_time(status: int) -> None:
    """Limit the time until the process has ended, if it has used ROS."""
    if 'rclpy' in sys.modules:
        import_module('mag_tracking.nodes.shutdown').limit_exit_time(status)


def driver_node() -> NoReturn:
    """The command driver_node."""
    run_node('driver_node')


def replay_node() -> NoReturn:
    """The command replay_node."""
    run_node('replay_node')


def calibration_node() -> NoReturn:
    """The command calibration_node."""
    run_node('calibration_node')


def detection_node() -> NoReturn:
    """The command detection_node."""
    run_node('detection_node')


def tracker_node() -> NoReturn:
    """The command tracker_node."""
    run_node('tracker_node')
