"""Services that lose no responses when many calls arrive simultaneously."""

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service import Service

from mag_tracking.nodes.steady_timer import steady_timer

RESPONSE_INTERVAL_S = 0.002
"""[s] Interval between responses."""
SERVICE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of the service; the queue is long enough for many simultaneous calls."""


def paced_service(node: Node, service_type: Any, name: str,
                  callback: Callable[[Any, Any], Any]) -> Service:
    """Create a service whose responses do not overflow the queues of its clients.

    Each client of a service receives the responses to all clients and by default stores the latest
    ten that it has not yet read. Without pacing, about half of forty simultaneous calls would get
    no response.
    """
    service = node.create_service(service_type, name, callback, qos_profile=SERVICE_QOS)
    send, queue = service.send_response, deque[tuple[Any, Any]]()

    def send_next() -> None:
        if queue:
            send(*queue.popleft())
        if not queue:
            timer.cancel()

    def send_later(response: Any, header: Any) -> None:
        queue.append((response, header))
        if timer.is_canceled():
            timer.reset()

    timer = steady_timer(node, RESPONSE_INTERVAL_S, send_next, autostart=False)
    service.send_response = send_later  # type: ignore[method-assign]
    return service
