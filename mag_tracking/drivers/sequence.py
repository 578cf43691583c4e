"""Detection of lost, late and duplicate readings by their sequence numbers."""

from collections import Counter

MAX_REMEMBERED = 1000
"""Maximum number of stored sequence numbers. An older number indicates a restarted sequence."""
MAX_GAP = 1_000_000
"""Largest gap counted as loss. A larger gap is counted as a jump of the sequence."""


class SequenceCheck:
    """Checks the sequence numbers of one sensor, which return to 0 at `wrap` (0: never).

    `counts` are lost, late, duplicate and implausible readings.
    """

    def __init__(self, wrap: int) -> None:
        self._wrap = wrap
        self.counts: Counter[str] = Counter()
        self._begin()

    def _begin(self) -> None:
        """Discard the stored numbers; the next reading starts a new sequence."""
        self._newest_number: int | None = None
        self._values: dict[int, bytes] = {}
        self._lost_numbers: dict[int, bool] = {}

    def pause(self) -> None:
        """Start a new sequence, so that numbers skipped during a pause are not counted as lost."""
        self._begin()

    def is_new(self, sequence: int, values: bytes) -> bool:
        """Record a reading; return whether it is not a duplicate (the same number and values).

        Skipped numbers are counted as lost; the count is corrected if they arrive late. An older
        number that is neither lost nor a duplicate restarts the sequence.
        """
        if sequence < 0 or self._wrap and sequence >= self._wrap:
            self.counts['sequence numbers out of range'] += 1
            return True
        distance = (1 if self._newest_number is None
                    else self._distance(sequence, self._newest_number))
        if distance > MAX_GAP:
            self.counts['sequence jumps'] += 1
            self._begin()
        elif distance > 0:
            self._record_gap(sequence, distance - 1)
        elif sequence in self._lost_numbers:
            del self._lost_numbers[sequence]
            self.counts['lost'] -= 1
            self.counts['late arrivals'] += 1
        elif self._values.get(sequence) == values:
            self.counts['duplicates'] += 1
            return False
        else:
            self.counts['sequence restarts'] += 1
            self._begin()
            distance = 1
        if distance > 0:
            self._newest_number = sequence
        self._values[sequence] = values
        _trim(self._values)
        return True

    def _distance(self, sequence: int, last: int) -> int:
        """Signed distance from `last` to `sequence`; negative if `sequence` is older."""
        distance = sequence - last
        if self._wrap:
            distance = (distance + self._wrap // 2) % self._wrap - self._wrap // 2
        return distance

    def _record_gap(self, sequence: int, n: int) -> None:
        """Count the `n` skipped numbers before `sequence` as lost."""
        if not n:
            return
        self.counts['lost'] += n
        for number in range(sequence - min(n, MAX_REMEMBERED), sequence):
            self._lost_numbers[number % self._wrap if self._wrap else number] = True
        _trim(self._lost_numbers)


def _trim(memory: dict[int, bytes] | dict[int, bool]) -> None:
    """Remove the oldest entries beyond `MAX_REMEMBERED`."""
    while len(memory) > MAX_REMEMBERED:
        del memory[next(iter(memory))]
