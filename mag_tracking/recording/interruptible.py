"""Reading that reports its progress and can be stopped."""

from collections.abc import Callable, Iterator
from typing import TypeAlias, TypeVar

Progress: TypeAlias = Callable[[int], object]
"""Called with the bytes done since the last call."""
_Item = TypeVar('_Item')

class ReadingStopped(Exception):
    """The caller asked for the reading to end here."""


def until_stopped(read: Callable[[Progress], Iterator[_Item]], progress: Progress | None = None,
                  stopped: Callable[[], bool] | None = None) -> Iterator[_Item]:
    """Iterate over the items of `read` until the caller stops it.

    Parameters
    ----------
    read : function
        Takes a function that it calls with the bytes done since the last call; returns an
        iterator.
    progress : function, optional
        Called with the bytes done since the last call.
    stopped : function, optional
        Asked after every item, and whenever the reading has advanced.

    Raises
    ------
    ReadingStopped
        When `stopped` returns true.
    """
    def advance(n: int) -> None:
        if progress is not None:
            progress(n)
        check()

    def check() -> None:
        if stopped is not None and stopped():
            raise ReadingStopped

    for item in read(advance):
        yield item
        check()
