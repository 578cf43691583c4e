"""Nodes as processes of their own, for the tests."""

import os
import signal
import subprocess
import sys
import tempfile

from mag_tracking.nodes.middleware import PROFILE_VARIABLE

MAX_S = 120.0
"""[s] Whatever a test waits for has come by then, also on a slow machine beside others."""


USUAL_START_S = 1.8
"""[s] From the start of a node's process until it is up, on a free machine."""


def scaled(limit_s, start_s):
    """A limit of a free machine, longer in proportion where a node takes `start_s` to start."""
    return limit_s * max(1.0, start_s / USUAL_START_S)


def start(module, *arguments, home=None):
    """A node in a process of its own, with no memory but what it finds in `home`."""
    return subprocess.Popen(
        [sys.executable, '-m', f'mag_tracking.nodes.{module}', '--ros-args', *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=environment(ROS_HOME=str(home or tempfile.mkdtemp(dir=os.environ['ROS_HOME']))))


def environment(**more):
    """That of a process that has to find the profile of the middleware by itself."""
    return {n: v for n, v in os.environ.items() if n != PROFILE_VARIABLE} | more


def stop(processes):
    """End them as Ctrl-C does; (exit codes, outputs)."""
    for p in processes:
        p.send_signal(signal.SIGINT)
    try:
        outputs = [p.communicate(timeout=MAX_S)[0] for p in processes]
    finally:
        # One that hangs would compute beside all that comes after.
        for p in processes:
            p.kill()
    return [p.returncode for p in processes], outputs


def without_states(output):
    """The output of nodes without the lines that tell what they wait for."""
    return ''.join(line for line in output.splitlines(keepends=True)
                   if not line.startswith('[INFO]'))


def call(ros, kind, name, request):
    """The response of a service; asked again where none comes.

    A client that finds a server is not yet known to it, and a response to nobody is dropped by
    the middleware.
    """
    node, spin_until = ros
    client = node.create_client(kind, name)
    assert spin_until(client.service_is_ready), f'there is no {name}'
    for _ in range(12):
        future = client.call_async(request)
        if spin_until(future.done, 10.0):
            return future.result()
    raise AssertionError(f'{name} has not answered')
