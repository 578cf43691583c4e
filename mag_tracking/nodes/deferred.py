"""Work that is deferred so that subscribers can process published messages first."""

from collections.abc import Callable

from rclpy.node import Node

from mag_tracking.nodes.steady_timer import steady_timer


class Deferred:
    """Calls a function `delay_s` after a request; requests in the meantime have no effect.

    On a computer with few cores, work immediately after publishing would compete with the processes
    that receive the messages.
    """

    def __init__(self, node: Node, delay_s: float, call: Callable[[], None]) -> None:
        self._call = call
        self._timer = steady_timer(node, delay_s, self._run, autostart=False)

    def request(self) -> None:
        """Schedule the call, unless it is already scheduled."""
        if self._timer.is_canceled():
            self._timer.reset()

    def _run(self) -> None:
        """Stop the timer and call the function."""
        self._timer.cancel()
        self._call()
