"""Base classes of transports that wait for data and may be closed by another thread."""

import io
import select
import socket
import threading
import time
from typing import Generic, TypeVar

CLOSE_WAIT_S = 0.1
"""[s] Maximum time that `close` waits for a `read` or, on a bus, for the cycle after it."""
H = TypeVar('H', bound=io.RawIOBase | socket.socket)


class Closable:
    """Resource that one thread reads and another may close.

    Every method of a subclass except `close` holds `_lock` while it uses the open resource, and
    checks `_closing` while it waits. `_release` closes the resource.
    """

    def __init__(self) -> None:
        self._lock, self._closing = threading.Lock(), False

    def close(self) -> None:
        """Close the resource, and make a `read` in another thread return."""
        self._closing = True
        with self._lock:
            self._release()
            self._closing = False

    def _release(self) -> None:
        """Close the resource if it is open."""
        raise NotImplementedError


class Polled(Closable, Generic[H]):
    """Transport with a handle (a port, a socket) that can be polled."""

    def __init__(self) -> None:
        super().__init__()
        self._handle: H | None = None
        self._poll = select.poll()

    def _attach(self, handle: H) -> None:
        """Store an open handle, and register it for polling."""
        self._handle, self._poll = handle, select.poll()
        self._poll.register(handle.fileno(), select.POLLIN)

    def _wait(self, timeout_s: float) -> int | None:
        """Wait for data; return the wake-up time [ns], or None after the timeout or `close`."""
        end = time.monotonic() + timeout_s
        while not self._closing:
            remaining = end - time.monotonic()
            if self._poll.poll(1e3 * max(0.0, min(remaining, CLOSE_WAIT_S))):
                return time.monotonic_ns()
            if remaining <= 0.0:
                break
        return None

    def _release(self) -> None:
        """Close the handle if it is open."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None
