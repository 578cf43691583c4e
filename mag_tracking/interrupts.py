"""Signals that end a program, taken note of or obeyed at once instead of raised.

Nothing is imported here that takes time: programs come here first.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def recorded_signals(*signals: signal.Signals) -> Iterator[list[int]]:
    """A list on which each of `signals` that comes is put, to be asked where it is safe to stop.

    Raised in the middle of an update or of a line of a table, it would leave half
    of it, and a library on the way might swallow it or turn it into an error of its
    own. The third is raised all the same, as KeyboardInterrupt. A signal that is
    ignored (SIGINT in a background job) stays so, and outside the main thread,
    where no handler can be set, the list stays empty.
    """
    seen: list[int] = []

    def note(signum: int, _: FrameType | None) -> None:
        seen.append(signum)
        if len(seen) > 2:
            raise KeyboardInterrupt

    with _handled_by(note, signals):
        yield seen


@contextmanager
def exit_on_signals(status: int, *signals: signal.Signals, message: str = '') -> Iterator[None]:
    """End the process at once, with `status` and a `message`, when one of `signals` comes.

    For the imports at the start of a program, when there is nothing to clean up: an exception
    raised in the middle of an import may be swallowed, or turned into another one. No buffer is
    flushed and no `finally` runs. Ignored signals and other threads are handled as in
    `recorded_signals`.
    """
    text = f'{message}\n'.encode() if message else b''

    def shut_down(_signum: int, _frame: FrameType | None) -> None:
        try:
            os.write(2, text)
        finally:
            os._exit(status)

    with _handled_by(shut_down, signals):
        yield


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None],
                signals: tuple[signal.Signals, ...]) -> Iterator[None]:
    """Have `handler` called with `signals`, but for those that are ignored."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {s: signal.getsignal(s) for s in signals}
        before = {s: known for s, known in before.items() if known is not signal.SIG_IGN}
    for s in before:
        signal.signal(s, handler)
    try:
        yield
    finally:
        for s, known in before.items():
            signal.signal(s, known)
