"""Work that is deferred until the recipients of published results have processed them."""

from collections.abc import Callable

from rclpy.node import Node

from mag_tracking.nodes.steady_timer import steady_timer


class Deferred:
    """Calls a function once, after a delay during which the node is idle.

    On a computer with few cores, work done immediately after publishing would take a core from the
    processes that the messages have just woken.

    Parameters
    ----------
    node : Node
    delay_s : float, s
    call : function
        Called without arguments.
    """

    def __init__(self, node: Node, delay_s: float, call: Callable[[], None]) -> None:
        self._call = call
        self._timer = steady_timer(node, delay_s, self._due, autostart=False)

    def request(self) -> None:
        """Schedule the call, unless it is already scheduled."""
        if self._timer.is_canceled():
            self._timer.reset()

    def _due(self) -> None:
        """Call the function once."""
        self._timer.cancel()
        self._call()
