"""Services that answer each of many calls."""

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service import Service

from mag_tracking.nodes.steady_timer import steady_timer

PACE_S = 0.002
"""[s] Between two answers."""
CALLS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Calls that wait for their turn."""


def paced_service(node: Node, service_type: Any, name: str,
                  callback: Callable[[Any, Any], Any]) -> Service:
    """A service whose answers do not overrun its callers.

    Every client of a service receives the answers to all of them, and by default keeps the latest
    ten that it has not yet looked at: of forty calls at once about half would get no answer.
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
