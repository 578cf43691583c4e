"""Work that can wait until those who wait for the results have them."""

from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


class Deferred:
    """Calls a function once, a while after it was asked to; meanwhile the node sleeps.

    What a node does at once behind its publishing takes a core from those that it has just
    woken, if there are few.
    """

    def __init__(self, node: Node, delay_s: float, call: Callable[[], None]) -> None:
        self._call = call
        # Not that of a recording, which may stand still.
        self._timer = node.create_timer(delay_s, self._due, autostart=False,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))

    def request(self) -> None:
        """Have it called; who has asked already waits no longer for that."""
        if self._timer.is_canceled():
            self._timer.reset()

    def _due(self) -> None:
        """Call it, once."""
        self._timer.cancel()
        self._call()
