"""Sensors whose clock steps ahead of all the others', told from a gap that all of them had.

Where stamps decide what is late, one clock that steps ahead would make all other sensors late.
"""


class Ahead:
    """Holds samples that jump ahead until it is known whether the other sensors jump, too.

    All others pass at once.
    """

    def __init__(self, n_sensors, limit):
        """`limit` [ns]: a longer jump is looked at, and samples are held for so long."""
        self._limit = limit
        self._latest = [None] * n_sensors
        self._newest = self._before = None
        self._held = []

    def feed(self, i, sample):
        """What is known by now of a sample of sensor `i`, and of those that are held.

        Returns
        -------
        passed, refused : lists of (i, sample)
            In the order in which they came.
        """
        stamp, last = sample.stamp_ns, self._latest[i]
        jumps = last is not None and stamp - last > self._limit \
            and stamp > self._newest + self._limit
        if not jumps:
            # It is back with the others: what it said of a time ahead of them was wrong.
            refused = self._take_out(i, float('inf')) if self._held else []
            return self._pass([(i, sample)]), refused
        if not self._held:
            self._before = self._newest
        self._held.append((i, sample))
        if self._most_agree(stamp) or self._is_alone(i, stamp):
            held, self._held = self._held, []
            return self._pass(held), []
        return [], self._take_out(i, stamp - self._limit)

    def flush(self):
        """[(i, sample)] of those that are held when nothing comes any more."""
        held, self._held = self._held, []
        return self._pass(held)

    def _pass(self, samples):
        """Note that `samples` are as they should be."""
        for i, sample in samples:
            self._latest[i] = sample.stamp_ns
            if self._newest is None or sample.stamp_ns > self._newest:
                self._newest = sample.stamp_ns
        return samples

    def _most_agree(self, stamp):
        """Whether most of the living sensors have jumped to about this stamp."""
        agree = {j for j, s in self._held if abs(s.stamp_ns - stamp) <= self._limit}
        alive = {j for j, latest in enumerate(self._latest)
                 if latest is not None and latest >= self._newest - self._limit}
        return 2 * len(agree) > len(agree | alive)

    def _is_alone(self, i, stamp):
        """Whether sensor `i` has jumped for a while and no other has said anything since."""
        first = next(s.stamp_ns for j, s in self._held if j == i)
        return self._newest == self._before and stamp - first >= self._limit

    def _take_out(self, i, before):
        """Those that are held of sensor `i` with stamps `before` this; they are held no more."""
        out = [(j, s) for j, s in self._held if j == i and s.stamp_ns < before]
        self._held = [(j, s) for j, s in self._held if j != i or s.stamp_ns >= before]
        return out
