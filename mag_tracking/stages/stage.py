"""Protocol of the pipeline stages."""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol, TypeVar

In = TypeVar('In', contravariant=True)
Out = TypeVar('Out')


class Stage(Protocol[In, Out]):
    """A step of the pipeline that takes one item at a time.

    A stage never pulls, never sleeps and never reads a clock. Time is that of the records.

    Attributes
    ----------
    counts : Counter of str
        Number of accepted, held back and rejected items, by cause. Every rejection is counted.
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
            The records that follow from it.
        """

    def idle(self) -> None:
        """Do deferred work after the outputs are published; results do not depend on it."""

    def flush(self) -> list[Out]:
        """Return the records that are held back when the input ends.

        Returns
        -------
        list of Out
        """


def rejected(counts: Mapping[str, int]) -> dict[str, int]:
    """Rejections among the counts of a stage.

    Parameters
    ----------
    counts : mapping of str to int

    Returns
    -------
    dict of str to int
        Number by cause, without the prefix `rejected:`.
    """
    return {k.removeprefix('rejected: '): n for k, n in sorted(counts.items())
            if k.startswith('rejected: ')}
