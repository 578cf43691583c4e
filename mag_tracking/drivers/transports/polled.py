"""What transports over a file descriptor have in common: waiting, and closing while one waits."""

import select
import threading
import time
from typing import Generic, Protocol, TypeVar

CLOSE_WAIT_S = 0.1
"""How long `close` may have to wait for a `read` in another thread."""


class Handle(Protocol):
    """What the kernel knows by a file descriptor."""

    def fileno(self) -> int:
        """The descriptor."""

    def close(self) -> None:
        """Close it."""


H = TypeVar('H', bound=Handle)


class Closable:
    """What a thread reads and another may close.

    Every method of a subclass but `close` holds `_lock` while it uses what is open, and
    looks at `_closing` where it waits; `_release` lets go of what is open.
    """

    def __init__(self) -> None:
        self._lock, self._closing = threading.Lock(), False

    def close(self) -> None:
        """Close it; a `read` in another thread returns."""
        self._closing = True
        with self._lock:
            self._release()
            self._closing = False

    def _release(self) -> None:
        """Let go of what is open."""
        raise NotImplementedError


class Polled(Closable, Generic[H]):
    """A transport whose handle (a port, a socket) the kernel tells when to read."""

    def __init__(self) -> None:
        super().__init__()
        self._handle: H | None = None
        self._poll = select.poll()

    def _hold(self, handle: H) -> None:
        """Use `handle`, which has `fileno` and `close`, from now on."""
        self._handle, self._poll = handle, select.poll()
        self._poll.register(handle.fileno(), select.POLLIN)

    def _wait(self, timeout_s: float) -> int | None:
        """Time when there was something to read [ns]; None if there was nothing."""
        end = time.monotonic() + timeout_s
        while not self._closing:
            left = end - time.monotonic()
            if self._poll.poll(1e3 * max(0.0, min(left, CLOSE_WAIT_S))):
                return time.monotonic_ns()
            if left <= 0.0:
                break
        return None

    def _release(self) -> None:
        """Let go of the handle, if there is one."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None
