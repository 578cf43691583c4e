"""Signals that end a program, taken note of instead of raised."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def noted_signals(*signals: signal.Signals) -> Iterator[list[int]]:
    """A list on which each of `signals` that comes is put, to be asked where it is safe to stop.

    Raised in the middle of an update or of a line of a table, it would leave half
    of it, and a library on the way might swallow it or turn it into an error of its
    own. The third is raised all the same, as KeyboardInterrupt. A signal that is
    ignored (SIGINT in a background job) stays so, and outside the main thread,
    where no handler can be set, the list stays empty.
    """
    seen: list[int] = []
    before: dict[signal.Signals, Callable[[int, FrameType | None], object] | int | None] = {}

    def note(signum: int, _: FrameType | None) -> None:
        seen.append(signum)
        if len(seen) > 2:
            raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        before = {s: signal.getsignal(s) for s in signals}
        before = {s: handler for s, handler in before.items() if handler is not signal.SIG_IGN}
    for s in before:
        signal.signal(s, note)
    try:
        yield seen
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)
