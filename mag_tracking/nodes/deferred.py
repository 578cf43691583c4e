"""Work that can wait until those who wait for the results have them."""

from collections.abc import Callable

from rclpy.node import Node

from mag_tracking.nodes.steady_timer import steady_timer


class Deferred:
    """Calls a function once, a while after it was asked to; meanwhile the node sleeps.

    What a node does at once behind its publishing takes a core from those that it has just
    woken, if there are few.
    """

    def __init__(self, node: Node, delay_s: float, call: Callable[[], None]) -> None:
        self._call = call
        self._timer = steady_timer(node, delay_s, self._due, autostart=False)

    def request(self) -> None:
        """Have it called; who has asked already waits no longer for that."""
        if self._timer.is_canceled():
            self._timer.reset()

    def _due(self) -> None:
        """Call it, once."""
        self._timer.cancel()
        self._call()
