"""Protocol of the pipeline stages."""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol, TypeVar

In = TypeVar('In', contravariant=True)
Out = TypeVar('Out')
MAX_BACKWARD_JUMP_S = 1.0
"""[s] Maximum backward jump of a timestamp; a larger one (a loop) discards all."""


class Stage(Protocol[In, Out]):
    """A step of the pipeline that processes one item at a time.

    A stage does not request input, sleep or read a clock. All times come from the records.

    Attributes
    ----------
    counts : Counter of str
        Number of accepted, buffered and rejected items, by cause. Every rejection is counted.
    """

    counts: Counter[str]

    def feed(self, item: In, /) -> list[Out]:
        """Process one item.

        Parameters
        ----------
        item : In
            A record or a batch of readings.

        Returns
        -------
        list of Out
            Resulting records.
        """

    def idle(self) -> None:
        """Do deferred work after the outputs have been published; this does not change results."""
        return None

    def flush(self) -> list[Out]:
        """Return the remaining records at the end of the input; by default, there are none.

        Returns
        -------
        list of Out
        """
        return []


def rejected(counts: Mapping[str, int]) -> dict[str, int]:
    """Select the rejections from the counts of a stage, without the prefix `rejected:`."""
    return {k.removeprefix('rejected: '): n for k, n in sorted(counts.items())
            if k.startswith('rejected: ')}
