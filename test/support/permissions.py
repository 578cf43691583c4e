"""Context in which file permissions also apply to root."""

import ctypes
from contextlib import contextmanager

VERSION = 0x20080522
"""_LINUX_CAPABILITY_VERSION_3 of the system call."""
OVERRIDE_BITS = 1 << 1 | 1 << 2
"""Bits of CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH."""


@contextmanager
def enforced_permissions():
    """Drop the capabilities by which root overrides file permissions; restore them afterwards.

    Only the current thread is affected.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    # Header: version, thread (0 = this one). Two rows: effective, permitted, inheritable.
    header, rows = (ctypes.c_uint32 * 2)(VERSION, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, rows) == 0
    before = rows[0]
    rows[0] &= ~OVERRIDE_BITS
    assert libc.capset(header, rows) == 0
    try:
        yield
    finally:
        rows[0] = before
        assert libc.capset(header, rows) == 0
