"""How every process with ROS ends."""

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

LEAVING_S = 4.0
"""[s] Longest time for leaving the middleware. Usually it takes 0.3 s; `ros2 launch` sends the next
signal 5 s after the first."""
HUNG = f'the middleware did not shut down within {LEAVING_S:g} s; the process was ended\n'


def shut_down(nodes: Sequence[Node], executor: Executor | None = None, status: int = 0) -> None:
    """Close and destroy nodes and shut ROS down; end the process if the middleware hangs.

    Workaround: Fast DDS 2.14 blocks for ever, and holds the interpreter's lock, when a participant
    is destroyed while another one leaves (eProsima/Fast-DDS 6513): 1 of 1165 nodes of which five
    were signalled at once. The deadline can be removed once that is fixed.

    Parameters
    ----------
    nodes : sequence of Node
    executor : Executor, optional
        The executor of the nodes.
    status : int
        Exit status of the process if it is ended here.
    """
    try:
        for node in nodes:
            if executor is not None:
                executor.remove_node(node)
            if isinstance(node, ManagedNode):
                # Devices have their own, longer time limit.
                node.close()
    finally:
        flush()
        with ExitStack() as stack:
            stack.callback(Deadline(LEAVING_S, status, _final_message()).cancel)
            stack.callback(rclpy.try_shutdown)
            if executor is not None:
                stack.callback(executor.shutdown)
            for node in reversed(nodes):
                stack.callback(node.destroy_node)


def limit_exit_time(status: int) -> None:
    """Limit the time until the process has ended, as `leave` does.

    A node whose constructor raised is destroyed only with the interpreter.
    """
    flush()
    end_within(LEAVING_S, status, HUNG.encode())


def flush() -> None:
    """Flush the standard streams; an error remains for the end of Python, which reports it."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.flush()


def _final_message() -> bytes:
    """Message of the deadline; begins with the pending error, which would not be printed."""
    error = sys.exc_info()[1]
    if error is None or isinstance(error, KeyboardInterrupt):
        pending = ''
    elif isinstance(error, MagTrackingError):
        pending = f'{error}\n'
    else:
        pending = ''.join(traceback.format_exception(error))
    return (pending + HUNG).encode(errors='backslashreplace')
