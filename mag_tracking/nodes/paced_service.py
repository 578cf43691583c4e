"""Services that respond to many simultaneous calls."""

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service import Service

from mag_tracking.nodes.steady_timer import steady_timer

PACE_S = 0.002
"""[s] Interval between two responses."""
CALLS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of the calls, which may have to be queued."""


def paced_service(node: Node, service_type: Any, name: str,
                  callback: Callable[[Any, Any], Any]) -> Service:
    """Create a service whose responses do not overflow the queues of its clients.

    Every client of a service receives the responses to all clients, and by default stores the
    latest ten that it has not yet read. About half of forty simultaneous calls would otherwise get
    no response.

    Parameters
    ----------
    node : Node
    service_type : type
    name : str
    callback : function
        As for `Node.create_service`.

    Returns
    -------
    Service
    """
    service = node.create_service(service_type, name, callback, qos_profile=CALLS)
    send, waiting = service.send_response, deque[tuple[Any, Any]]()

    def send_next() -> None:
        if waiting:
            send(*waiting.popleft())
        if not waiting:
            timer.cancel()

    def send_later(response: Any, header: Any) -> None:
        waiting.append((response, header))
        if timer.is_canceled():
            timer.reset()

    timer = steady_timer(node, PACE_S, send_next, autostart=False)
    service.send_response = send_later  # type: ignore[method-assign]
    return service
