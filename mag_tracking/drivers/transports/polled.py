"""Common parts of transports over a file descriptor: waiting, and closing during a wait."""

import select
import threading
import time
from typing import Generic, Protocol, TypeVar

CLOSE_WAIT_S = 0.1
"""[s] Maximum time that `close` waits for a `read` in another thread."""


class Handle(Protocol):
    """Object with a file descriptor."""

    def fileno(self) -> int:
        """File descriptor.

        Returns
        -------
        int
        """

    def close(self) -> None:
        """Close the descriptor."""


H = TypeVar('H', bound=Handle)


class Closable:
    """Resource that one thread reads and another may close.

    Every method of a subclass except `close` holds `_lock` while it uses the open resource, and
    checks `_closing` while it waits. `_release` closes the resource.
    """

    def __init__(self) -> None:
        self._lock, self._closing = threading.Lock(), False

    def close(self) -> None:
        """Close the resource; a `read` in another thread returns."""
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
        """Use `handle` from now on."""
        self._handle, self._poll = handle, select.poll()
        self._poll.register(handle.fileno(), select.POLLIN)

    def _wait(self, timeout_s: float) -> int | None:
        """Time at which data became available [ns]; None if none did."""
        end = time.monotonic() + timeout_s
        while not self._closing:
            left = end - time.monotonic()
            if self._poll.poll(1e3 * max(0.0, min(left, CLOSE_WAIT_S))):
                return time.monotonic_ns()
            if left <= 0.0:
                break
        return None

    def _release(self) -> None:
        """Close the handle, if there is one."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None
