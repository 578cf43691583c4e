"""Shared memory segments in /dev/shm that are open or have been left behind."""

import os
from contextlib import suppress


def segments_of(pid):
    """Names of the segments in /dev/shm that a process has open."""
    files = [os.path.realpath(f'/proc/{pid}/fd/{n}') for n in os.listdir(f'/proc/{pid}/fd')]
    with open(f'/proc/{pid}/maps') as stream:
        files += [line.split()[-1] for line in stream]
    return {f.removeprefix('/dev/shm/') for f in files if f.startswith('/dev/shm/')}


def orphaned_segments(names):
    """Select the segments of `names` that still exist although no running process has them open."""
    # A process also opens segments of other processes, such as those of another test.
    orphans = {n for n in names & set(os.listdir('/dev/shm')) if not n.startswith('sem.')}
    for pid in filter(str.isdigit, os.listdir('/proc') if orphans else ()):
        with suppress(OSError):
            orphans -= segments_of(pid)
    return orphans
