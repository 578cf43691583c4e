"""Handling of termination signals. Programs import this module first: it has no slow imports."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def recorded_signals(*signals: signal.Signals) -> Iterator[list[int]]:
    """Record termination signals in a growing list, so that a program can stop where it is safe.

    An exception could interrupt the writing of a table row, and a library could suppress it. Only
    the third signal raises KeyboardInterrupt. Ignored signals (SIGINT in a background job) remain
    ignored. Outside the main thread, the list stays empty.
    """
    received: list[int] = []

    def record(signum: int, _: FrameType | None) -> None:
        received.append(signum)
        if len(received) > 2:
            raise KeyboardInterrupt

    with _temporary_handler(record, signals):
        yield received


@contextmanager
def exit_on_signals(status: int, *signals: signal.Signals, message: str = '') -> Iterator[None]:
    """Exit immediately with `status` when one of `signals` arrives; write `message` to stderr.

    This is intended for the imports at the start of a program: an exception during an import may be
    suppressed or converted. Buffers are not flushed, and no `finally` block runs. Ignored signals
    remain ignored, and a call outside the main thread has no effect.
    """
    text = f'{message}\n'.encode() if message else b''

    def shut_down(_signum: int, _frame: FrameType | None) -> None:
        try:
            os.write(2, text)
        finally:
            os._exit(status)

    with _temporary_handler(shut_down, signals):
        yield


@contextmanager
def _temporary_handler(handler: Callable[[int, FrameType | None], None],
                       signals: tuple[signal.Signals, ...]) -> Iterator[None]:
    """Install `handler` for all `signals` that are not ignored, until the context ends."""
    old_handlers = {}
    if threading.current_thread() is threading.main_thread():
        old_handlers = {s: signal.getsignal(s) for s in signals}
        old_handlers = {s: old for s, old in old_handlers.items() if old is not signal.SIG_IGN}
    for s in old_handlers:
        signal.signal(s, handler)
    try:
        yield
    finally:
        for s, old in old_handlers.items():
            signal.signal(s, old)
