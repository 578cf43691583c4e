"""Timers on a steady clock."""

from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.timer import Timer


def steady_timer(node: Node, seconds: float, call: Callable[[], None],
                 autostart: bool = True) -> Timer:
    """Create a timer, with a period in s, that is independent of simulated time."""
    return node.create_timer(seconds, call, autostart=autostart,
                             clock=Clock(clock_type=ClockType.STEADY_TIME))
