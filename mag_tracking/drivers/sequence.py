"""What was lost on the way, by the count of readings that a device sends along."""

from collections import Counter

MEMORY = 1000
"""Readings that are remembered. What is further behind is not late: the count has begun anew."""
FARTHEST = 1_000_000
"""A count that is further ahead has jumped; hours of loss look otherwise."""


class SequenceCheck:
    """Looks at the sequence numbers of one sensor."""

    def __init__(self, wrap: int) -> None:
        """`wrap` is the number at which the count goes back to 0; 0 = never."""
        self._wrap = wrap
        self.counts: Counter[str] = Counter()
        self._begin()

    def _begin(self) -> None:
        """A new count."""
        self._last: int | None = None
        self._seen: dict[int, bytes] = {}
        self._missing: dict[int, bool] = {}

    def pause(self) -> None:
        """Begin a new count: readings during a deliberate pause are not lost."""
        self._begin()

    def is_new(self, sequence: int, values: bytes) -> bool:
        """Whether the reading with this number and these `values`, bytes, has not come before.

        Counts what is missing; a late one is taken off again. A number that has come
        already with other values is not a duplicate but a count begun anew.
        """
        if sequence < 0 or self._wrap and sequence >= self._wrap:
            self.counts['sequence numbers out of range'] += 1
            return True
        ahead = 1 if self._last is None else self._ahead(sequence, self._last)
        if ahead > FARTHEST:
            self.counts['sequence jumped'] += 1
            self._begin()
        elif ahead > 0:
            self._skip(sequence, ahead - 1)
        elif sequence in self._missing:
            del self._missing[sequence]
            self.counts['lost'] -= 1
            self.counts['came late'] += 1
        elif self._seen.get(sequence) == values:
            self.counts['duplicates'] += 1
            return False
        else:
            self.counts['sequence begun anew'] += 1
            self._begin()
            ahead = 1
        if ahead > 0:
            self._last = sequence
        self._seen[sequence] = values
        _shorten(self._seen)
        return True

    def _ahead(self, sequence: int, last: int) -> int:
        """How far `sequence` is ahead of `last`; negative where it is behind."""
        ahead = sequence - last
        if self._wrap:
            ahead = (ahead + self._wrap // 2) % self._wrap - self._wrap // 2
        return ahead

    def _skip(self, sequence: int, n: int) -> None:
        """Note that the `n` numbers before `sequence` have not come."""
        if not n:
            return
        self.counts['lost'] += n
        for number in range(sequence - min(n, MEMORY), sequence):
            self._missing[number % self._wrap if self._wrap else number] = True
        _shorten(self._missing)


def _shorten(memory: dict[int, bytes] | dict[int, bool]) -> None:
    """Forget the oldest of a dict."""
    while len(memory) > MEMORY:
        del memory[next(iter(memory))]
