"""What every step of the way has in common."""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol, TypeVar

In = TypeVar('In', contravariant=True)
Out = TypeVar('Out')


class Stage(Protocol[In, Out]):
    """It is fed one item at a time and returns the records that follow.

    It never pulls, never sleeps and never reads a clock: time is what the
    records carry. `counts` tells what was taken, held back and rejected, by
    cause, so that nothing is lost without a word.
    """

    counts: Counter[str]

    def feed(self, item: In, /) -> list[Out]:
        """Take one item, a record or a batch of readings; return the records that follow."""

    def idle(self) -> None:
        """Do work that may wait until the outputs are published; results do not depend on it."""

    def flush(self) -> list[Out]:
        """The input has ended: return what was still held back."""


def rejected(counts: Mapping[str, int]) -> dict[str, int]:
    """The rejections among `counts`: {cause: number}, without their prefix."""
    return {k.removeprefix('rejected: '): n for k, n in sorted(counts.items())
            if k.startswith('rejected: ')}
