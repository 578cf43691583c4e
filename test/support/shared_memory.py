"""Shared memory segments that processes leave in /dev/shm."""

import os
from contextlib import suppress


def segments_of(pid):
    """Names in /dev/shm that a process has open."""
    files = [os.path.realpath(f'/proc/{pid}/fd/{n}') for n in os.listdir(f'/proc/{pid}/fd')]
    with open(f'/proc/{pid}/maps') as stream:
        files += [line.split()[-1] for line in stream]
    return {f.removeprefix('/dev/shm/') for f in files if f.startswith('/dev/shm/')}


def left_behind(names):
    """Those of `names` that remain in /dev/shm and that no running process has open."""
    # A process also opens segments of others, such as those of another test.
    left = {n for n in names & set(os.listdir('/dev/shm')) if not n.startswith('sem.')}
    for pid in filter(str.isdigit, os.listdir('/proc') if left else ()):
        with suppress(OSError):
            left -= segments_of(pid)
    return left
