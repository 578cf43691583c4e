"""Iteration over a recording that reports its progress and can be stopped by the caller."""

from collections.abc import Callable, Iterator
from typing import TypeAlias, TypeVar

Progress: TypeAlias = Callable[[int], object]
"""Function that is called with the number of bytes read since the last call."""
_Item = TypeVar('_Item')

class ReadingStopped(Exception):
    """Raised when the caller stops the reading."""


def until_stopped(read: Callable[[Progress], Iterator[_Item]], progress: Progress | None = None,
                  stopped: Callable[[], bool] | None = None) -> Iterator[_Item]:
    """Iterate over the items of `read`, which calls its `Progress` argument while it reads.

    `stopped` is called after every item and every progress report; ReadingStopped is raised when it
    returns true.
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
