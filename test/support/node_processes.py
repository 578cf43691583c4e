"""Start, stop and service calls of nodes that run as separate processes."""

import os
import signal
import subprocess
import sys
import tempfile
import time

from mag_tracking.nodes.middleware import PROFILE_VARIABLE

MAX_S = 120.0
"""[s] Time limit for any event, even on a slow and busy machine."""


USUAL_START_S = 1.8
"""[s] Start-up time of a node process on an idle machine."""


def scaled(limit_s, start_s):
    """Extend a time limit for an idle machine in proportion to the measured start-up time
    `start_s`."""
    return limit_s * max(1.0, start_s / USUAL_START_S)


def until_quiet(spin_until, received, seconds=0.5):
    """Wait until no message has been appended to `received` for `seconds`; return their number.

    On a busy machine, messages arrive long after their publisher was stopped.
    """
    n, end = -1, time.monotonic() + MAX_S
    while n != len(received):
        assert time.monotonic() < end, 'messages continue to arrive'
        n = len(received)
        spin_until(lambda: False, seconds)
    return n


def start(module, *arguments, home=None):
    """Start a node as a process, in a home folder without files of earlier runs."""
    return subprocess.Popen(
        [sys.executable, '-m', f'mag_tracking.nodes.{module}', '--ros-args', *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=environment(ROS_HOME=str(home or tempfile.mkdtemp(dir=os.environ['ROS_HOME']))))


def environment(**more):
    """Environment without the path of the middleware profile, which a node must find itself."""
    return {n: v for n, v in os.environ.items() if n != PROFILE_VARIABLE} | more


def stop(processes):
    """Interrupt processes as Ctrl-C does; return (exit codes, outputs)."""
    for p in processes:
        p.send_signal(signal.SIGINT)
    try:
        outputs = [p.communicate(timeout=MAX_S)[0] for p in processes]
    finally:
        # A process that hangs would slow down all later tests.
        for p in processes:
            p.kill()
    return [p.returncode for p in processes], outputs


def without_info_lines(output):
    """Remove the INFO lines from the output of nodes."""
    return ''.join(line for line in output.splitlines(keepends=True)
                   if not line.startswith('[INFO]'))


def call(ros, kind, name, request):
    """Call a service and return the response; repeat the request if no response arrives."""
    node, spin_until = ros
    client = node.create_client(kind, name)
    assert spin_until(client.service_is_ready), f'service {name} is not available'
    # A client may find a server before the server knows the client. The middleware then drops
    # the response.
    for _ in range(12):
        future = client.call_async(request)
        if spin_until(future.done, 10.0):
            return future.result()
    raise AssertionError(f'service {name} has not answered')
