"""Readings of one sensor that cannot be: spikes, and a sensor that is stuck.

Neither waits for more than what is odd: all other readings pass at once.
"""

import math
from collections import deque
from math import isnan

LEAST_CHANGES = 50
"""A sensor that has changed less often may have steps so coarse that it repeats itself for long."""
LIKELY = math.log(1e-9)
"""A run of the same reading is taken for a fault where chance makes it no oftener."""
SHORTEST_RUN = 4
MEMORY = 20_000
"""Readings that the usual repetitions are counted over, about."""
MOST_HELD = 3
"""A spike has at most so many readings; what stays for longer is a step."""
RECENT = 8
"""Steps from one reading to the next that a spike is compared with."""
STEEPER = 8.0
"""A spike is steeper than the steepest of those by so much."""
BACK = 0.3
"""Behind a spike the field is again where it was, to this share of the spike."""

STUCK, SPIKE = 'the same reading over and over', 'spike'
"""Why a reading is rejected."""


class Repetition:
    """Tells when a sensor repeats itself longer than chance, or its coarse steps, would have it."""

    def __init__(self):
        self._last, self._run = None, 0
        self._repeats, self._changes = 0.0, 0.0

    def is_stuck(self, field):
        """Whether the reading `field`, a list of three, is one of a sensor that is stuck."""
        same = self._last is not None and all(
            a == b or isnan(a) and isnan(b) for a, b in zip(field, self._last, strict=True))
        self._last = field
        if not same:
            # A run that was taken for a fault says nothing about what is usual.
            if not self._too_long():
                self._repeats += self._run
            self._run = 0
            self._changes += 1.0
            if self._repeats + self._changes > MEMORY:
                self._repeats, self._changes = 0.5 * self._repeats, 0.5 * self._changes
            return False
        self._run += 1
        return self._too_long()

    def _too_long(self):
        """Whether the run so far is longer than what is likely."""
        if self._run < SHORTEST_RUN or self._changes < LEAST_CHANGES:
            return False
        usual = (self._repeats + 1.0) / (self._repeats + self._changes + 2.0)
        return self._run * math.log(usual) < LIKELY


class SpikeFilter:
    """Holds a reading that is steeply off until those behind it tell whether it was a spike.

    A reading is off where it differs from the one before by more than `threshold`
    noise deviations, and by `STEEPER` times more than readings did just now: a
    vehicle comes nearer smoothly.
    """

    def __init__(self, threshold):
        self._threshold = threshold
        self.clear()

    def clear(self):
        """Forget what came before."""
        self._before, self._held = None, []
        self._steps = deque(maxlen=RECENT)

    def feed(self, item, field, noise_std):
        """What is known by now of `item`, a reading, and of those that are held.

        Parameters
        ----------
        item : anything
        field : list of 3 float [T]
        noise_std : (3,) [T], or None where it is not known: then nothing is held

        Returns
        -------
        list of (item, whether it is a spike), in the order in which they came
        """
        if self._before is None or noise_std is None:
            return self._release(item, field)
        steps = [abs(a - b) for a, b in zip(field, self._before, strict=True)]
        if self._held:
            return self._settle(item, field, steps)
        usual = [max((s[axis] for s in self._steps if not isnan(s[axis])),
                     default=math.inf)
                 for axis in range(3)]
        # A comparison with NaN is false: an axis that is missing is no spike.
        if len(self._steps) == RECENT and any(
                s > self._threshold * n and s > STEEPER * u
                for s, n, u in zip(steps, noise_std, usual, strict=True)):
            self._held.append((item, field, steps))
            return []
        return self._release(item, field, steps)

    def _settle(self, item, field, steps):
        """Whether what is held was a spike, if `field` tells."""
        largest = [max((h[2][axis] for h in self._held if not isnan(h[2][axis])),
                       default=0.0)
                   for axis in range(3)]
        # The axis in which it is the highest decides.
        axis = max(range(3), key=largest.__getitem__)
        if steps[axis] <= BACK * largest[axis]:
            spikes = [(held, True) for held, _, _ in self._held]
            self._held = []
            return spikes + self._release(item, field, steps)
        if len(self._held) < MOST_HELD:
            self._held.append((item, field, steps))
            return []
        whole = [(held, False) for held, _, _ in self._held]
        self._held = []
        # A step: what was before it is nothing to compare with.
        self._steps.clear()
        return whole + self._release(item, field)

    def _release(self, item, field, steps=None):
        """The reading passes."""
        self._before = field
        if steps is not None:
            self._steps.append(steps)
        return [(item, False)]

    def flush(self):
        """What is held when nothing comes any more: readings like others, as far as is known."""
        out = [(held, False) for held, _, _ in self._held]
        self.clear()
        return out
