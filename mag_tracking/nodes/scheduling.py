"""Timers on a steady clock, deferred work, and services with paced responses."""

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.timer import Timer


def steady_timer(node: Node, seconds: float, call: Callable[[], None],
                 autostart: bool = True) -> Timer:
    """Create a timer, with a period in s, that is independent of simulated time."""
    return node.create_timer(seconds, call, autostart=autostart,
                             clock=Clock(clock_type=ClockType.STEADY_TIME))


class Deferred:
    """Calls a function `delay_s` after requests, so that receivers of messages come first."""

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


RESPONSE_INTERVAL_S = 0.002
"""[s] Interval between the responses of a service."""


def paced_service(node: Node, service_type: Any, name: str,
                  callback: Callable[[Any, Any], Any]) -> Service:
    """Create a service whose responses do not overflow the queues of its clients: each client
    receives the responses to all clients, and by default stores ten of them."""
    # The queue is long enough for many simultaneous calls.
    service = node.create_service(service_type, name, callback, qos_profile=QoSProfile(
        depth=1000, reliability=ReliabilityPolicy.RELIABLE))
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
