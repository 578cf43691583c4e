"""Shutdown of ROS, common to all processes."""

import sys
import traceback
from collections.abc import Sequence
from contextlib import ExitStack, suppress

import rclpy
from rclpy.executors import Executor
from rclpy.node import Node

from mag_tracking.errors import MagTrackingError
from mag_tracking.nodes.core import Deadline, end_within
from mag_tracking.nodes.managed_node import ManagedNode

SHUTDOWN_TIMEOUT_S = 4.0
"""[s] Maximum time for the shutdown of the middleware. It usually takes 0.3 s; `ros2 launch` sends
the next signal 5 s after the first."""
HUNG_MESSAGE = (f'the middleware did not shut down within {SHUTDOWN_TIMEOUT_S:g} s; '
                'the process was ended\n')


def shut_down(nodes: Sequence[Node], executor: Executor | None = None, status: int = 0) -> None:
    """Close and destroy nodes and shut ROS down; end the process if the middleware hangs.

    Workaround: Fast DDS 2.14 blocks forever, while it holds the interpreter lock, if a participant
    is destroyed while another one leaves (eProsima/Fast-DDS 6513). This happened to 1 of 1165 nodes
    when five nodes were signalled at once. The deadline can be removed once Fast DDS is fixed.
    `status` is the exit status if the deadline ends the process.
    """
    try:
        for node in nodes:
            if executor is not None:
                executor.remove_node(node)
            if isinstance(node, ManagedNode):
                # Closing devices has its own, longer timeout.
                node.close()
    finally:
        flush()
        with ExitStack() as stack:
            stack.callback(Deadline(SHUTDOWN_TIMEOUT_S, status, _final_message()).cancel)
            stack.callback(rclpy.try_shutdown)
            if executor is not None:
                stack.callback(executor.shutdown)
            for node in reversed(nodes):
                stack.callback(node.destroy_node)


def limit_exit_time(status: int) -> None:
    """Limit the time until the process ends with `status`, with the same timeout as `shut_down`.

    If the constructor of a node fails, the node is destroyed with the interpreter, which may hang.
    """
    flush()
    end_within(SHUTDOWN_TIMEOUT_S, status, HUNG_MESSAGE.encode())


def flush() -> None:
    """Flush the standard streams; errors are left to Python, which reports them at exit."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.flush()


def _final_message() -> bytes:
    """Return the pending error, if any, which would otherwise be lost, and the timeout message."""
    error = sys.exc_info()[1]
    if error is None or isinstance(error, KeyboardInterrupt):
        pending = ''
    elif isinstance(error, MagTrackingError):
        pending = f'{error}\n'
    else:
        pending = ''.join(traceback.format_exception(error))
    return (pending + HUNG_MESSAGE).encode(errors='backslashreplace')
