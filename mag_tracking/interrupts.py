"""Termination signals that are recorded or obeyed at once instead of raising an exception.

Programs import this module first, so it imports nothing that takes time.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def recorded_signals(*signals: signal.Signals) -> Iterator[list[int]]:
    """Record termination signals, so that a program can check them where it is safe to stop.

    An exception raised in the middle of an update or of a table row would leave half of it, and a
    library could swallow the exception or convert it. The third signal nevertheless raises
    KeyboardInterrupt. A signal that is ignored (SIGINT in a background job) remains ignored.
    Outside the main thread, where no handler can be set, the list stays empty.

    Parameters
    ----------
    *signals : signal.Signals

    Yields
    ------
    list of int
        Numbers of the signals received so far.
    """
    seen: list[int] = []

    def note(signum: int, _: FrameType | None) -> None:
        seen.append(signum)
        if len(seen) > 2:
            raise KeyboardInterrupt

    with _handler_installed(note, signals):
        yield seen


@contextmanager
def exit_on_signals(status: int, *signals: signal.Signals, message: str = '') -> Iterator[None]:
    """End the process at once when one of `signals` arrives.

    For the imports at the start of a program, when there is nothing to clean up: an exception
    raised in the middle of an import may be swallowed or converted. No buffer is flushed and no
    `finally` runs. Ignored signals and other threads are handled as in `recorded_signals`.

    Parameters
    ----------
    status : int
        Exit status of the process.
    *signals : signal.Signals
    message : str, optional
        Line to write to standard error.

    Yields
    ------
    None
    """
    text = f'{message}\n'.encode() if message else b''

    def shut_down(_signum: int, _frame: FrameType | None) -> None:
        try:
            os.write(2, text)
        finally:
            os._exit(status)

    with _handler_installed(shut_down, signals):
        yield


@contextmanager
def _handler_installed(handler: Callable[[int, FrameType | None], None],
                       signals: tuple[signal.Signals, ...]) -> Iterator[None]:
    """Install `handler` for those `signals` that are not ignored."""
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
