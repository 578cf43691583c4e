"""How every process ends with ROS."""

import sys
from collections.abc import Sequence
from contextlib import suppress

import rclpy
from rclpy.executors import Executor
from rclpy.node import Node

from mag_tracking.nodes.core import Deadline
from mag_tracking.nodes.managed_node import ManagedNode

LEAVING_S = 4.0
"""[s] Longest time for leaving the middleware. It takes .3 s; `ros2 launch` sends the next signal
5 s after the first."""


def leave(nodes: Sequence[Node], executor: Executor | None = None, status: int = 0) -> None:
    """Close and destroy nodes and shut ROS down; end the process if the middleware hangs.

    Workaround: Fast DDS 2.14 spins for ever, with the lock of Python in hand, where a participant
    is destroyed while another one is just leaving (eProsima/Fast-DDS 6513). Of nodes that are all
    signalled at once one in some hundred does. The `Deadline` can go with that.

    Parameters
    ----------
    nodes : sequence of Node
    executor : Executor, optional
        The one that they are in.
    status : int
        Exit status of the process if it is ended here.
    """
    for node in nodes:
        if executor is not None:
            executor.remove_node(node)
        if isinstance(node, ManagedNode):
            node.close()
    for stream in (sys.stdout, sys.stderr):
        # Whoever read it has left; Python says so once more at its end.
        with suppress(BrokenPipeError):
            stream.flush()
    # An error that is on its way would not be printed any more.
    error = sys.exc_info()[1]
    deadline = Deadline(LEAVING_S, status, (f'{error}\n' if error is not None else '') +
                        f'the middleware has not let go within {LEAVING_S:g} s; the process was '
                        'ended\n')
    try:
        for node in nodes:
            node.destroy_node()
        if executor is not None:
            executor.shutdown()
        rclpy.try_shutdown()
    finally:
        deadline.cancel()
