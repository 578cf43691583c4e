"""Readings of one sensor that cannot be: spikes, and a sensor that is stuck.

Neither waits for more than what is odd: all other readings pass at once.
"""

import math
from collections.abc import Sequence
from math import isnan
from typing import Generic, TypeAlias, TypeVar

from mag_tracking.arrays import StructArray
from mag_tracking.calibration.ordinary import MEMORY, NEVER, RECENT, new_sensors

LEAST_CHANGES = 50
"""A sensor that has changed less often may have steps so coarse that it repeats itself for long."""
LIKELY = math.log(1e-9)
"""A run of the same reading is taken for a fault where chance makes it no oftener."""
SHORTEST_RUN = 4
COARSE = 0.05
"""Of a sensor that repeats itself more often the steps are so coarse that at rest it may do so for
ever; with a noise of one step or more, on three axes, it is below this."""
MOST_HELD = 3
"""A spike has at most so many readings; what stays for longer is a step."""
STEEPER = 8.0
"""A spike is steeper than the steepest of those by so much, and by more where readings are rare."""
FASTEST = 30.0
"""[1/s] How fast what passes may be, in units of its distance: 30 m/s at one metre."""
STEEPEST = 130.0
"""A dipole that passes by the share s of its distance from one reading to the next, s above 0.4, is
steeper than before by less than this times s^3, in 99.9 of 100 cases (simulated)."""
BACK = 0.3
"""Behind a spike the field is again where it was, to this share of the spike."""

STUCK, SPIKE = 'the same reading over and over', 'spike'
"""Why a reading is rejected."""

Item = TypeVar('Item')
"""Whatever a reading is to who feeds it."""
_Steps: TypeAlias = tuple[float, float, float]


class Repetition:
    """Tells when a sensor repeats itself longer than chance, or its coarse steps, would have it.

    Its state is in `sensors`, (1,) `ordinary.SENSOR`.
    """

    def __init__(self, sensors: StructArray | None = None) -> None:
        self._state = (new_sensors(1) if sensors is None else sensors)[0]

    def is_stuck(self, field: list[float]) -> bool:
        """Whether the reading `field`, a list of three, is one of a sensor that is stuck."""
        s = self._state
        last, s['last'] = s['last'].tolist(), field
        same = field == last or isnan(sum(field)) and all(
            a == b or isnan(a) and isnan(b) for a, b in zip(field, last, strict=True))
        if not same:
            # A run that was taken for a fault says little about what is usual. But were it nothing,
            # a sensor with coarse steps that began while a target passed would be stuck at rest.
            if s['run']:
                s['repeats'] += 1.0 if self._too_long() else s['run']
                s['run'] = 0
            s['changes'] += 1.0
            if s['repeats'] + s['changes'] > MEMORY:
                s['repeats'], s['changes'] = 0.5 * s['repeats'], 0.5 * s['changes']
            return False
        s['run'] += 1
        return self._too_long()

    def _too_long(self) -> bool:
        """Whether the run so far is longer than what is likely."""
        run, repeats, changes = (self._state[k] for k in ('run', 'repeats', 'changes'))
        if run < SHORTEST_RUN or changes < LEAST_CHANGES:
            return False
        usual = (repeats + 1.0) / (repeats + changes + 2.0)
        return bool(usual < COARSE and run * math.log(usual) < LIKELY)


class SpikeFilter(Generic[Item]):
    """Holds a reading that is steeply off until those behind it tell whether it was a spike.

    A reading is off where it differs from the one before by more than `threshold`
    noise deviations, and by `STEEPER` times more than readings did just now: a
    vehicle comes nearer smoothly. Where readings are so rare that it may pass from
    one to the next but a few, only what is steeper still can be told from it. What is
    not held is in `sensors`, (1,) `ordinary.SENSOR`.
    """

    def __init__(self, threshold: float, sensors: StructArray | None = None) -> None:
        self._threshold = threshold
        self._state = (new_sensors(1) if sensors is None else sensors)[0]
        self.clear()

    @property
    def n_held(self) -> int:
        """How many readings are held."""
        return len(self._held)

    def clear(self) -> None:
        """Forget what came before."""
        self._held: list[tuple[Item, int, list[float], _Steps]] = []
        self._state['before_ns'], self._state['n_steps'] = NEVER, 0

    def feed(self, item: Item, stamp_ns: int, field: list[float],
             noise_std: Sequence[float] | None) -> list[tuple[Item, bool]]:
        """What is known by now of `item`, a reading, and of those that are held.

        Parameters
        ----------
        item : anything
        stamp_ns : int
        field : list of 3 float [T]
        noise_std : (3,) [T], or None where it is not known: then nothing is held

        Returns
        -------
        list of (item, whether it is a spike), in the order in which they came
        """
        new = item, stamp_ns, field
        if self._state['before_ns'] == NEVER or noise_std is None:
            held = [(h[0], False) for h in self._held]
            self._held = []
            return held + self._release(*new)
        (x, y, z), (a, b, c) = field, self._state['before'].tolist()
        steps = abs(x - a), abs(y - b), abs(z - c)
        if self._held:
            return self._settle(*new, steps, noise_std)
        return self._judge(*new, steps, noise_std)

    def _judge(self, item: Item, stamp_ns: int, field: list[float], steps: _Steps,
               noise_std: Sequence[float]) -> list[tuple[Item, bool]]:
        """Hold a reading that may be a spike; else it passes."""
        if self._state['n_steps'] >= RECENT and self._is_off(stamp_ns, steps, noise_std):
            self._held.append((item, stamp_ns, field, steps))
            return []
        return self._release(item, stamp_ns, field, steps)

    def _is_off(self, stamp_ns: int, steps: _Steps, noise_std: Sequence[float]) -> bool:
        """Whether `steps` from the reading before are steeper than what passes could make them."""
        # A comparison with NaN is false: an axis that is missing is no spike.
        (x, y, z), (a, b, c), most = steps, noise_std, self._threshold
        high = x > most * a, y > most * b, z > most * c
        if True not in high:
            return False
        passed = FASTEST * (stamp_ns - int(self._state['before_ns'])) * 1e-9
        steeper, recent = max(STEEPER, STEEPEST * passed**3), self._state['steps'].tolist()
        for axis in range(3):
            known = [s[axis] for s in recent if not isnan(s[axis])]
            # A sensor with coarse steps did not move at all just now.
            if high[axis] and known and steps[axis] > steeper * max(*known, noise_std[axis]):
                return True
        return False

    def _settle(self, item: Item, stamp_ns: int, field: list[float], steps: _Steps,
                noise_std: Sequence[float]) -> list[tuple[Item, bool]]:
        """Whether what is held was a spike, if `field` tells."""
        largest = [max((h[3][axis] for h in self._held if not isnan(h[3][axis])),
                       default=0.0)
                   for axis in range(3)]
        # The axis in which it is the highest decides.
        axis = max(range(3), key=largest.__getitem__)
        is_back = steps[axis] <= BACK * largest[axis]
        if not is_back and len(self._held) < MOST_HELD:
            self._held.append((item, stamp_ns, field, steps))
            return []
        known = [(h[0], is_back) for h in self._held]
        self._held = []
        if is_back:
            # It may be the next of several that differ.
            return known + self._judge(item, stamp_ns, field, steps, noise_std)
        # A step: what was before it is nothing to compare with.
        self._state['n_steps'] = 0
        return known + self._release(item, stamp_ns, field)

    def _release(self, item: Item, stamp_ns: int, field: list[float],
                 steps: _Steps | None = None) -> list[tuple[Item, bool]]:
        """The reading passes."""
        s = self._state
        s['before'], s['before_ns'] = field, stamp_ns
        if steps is not None:
            s['steps'][s['n_steps'] % RECENT] = steps
            s['n_steps'] += 1
        return [(item, False)]

    def flush(self) -> list[tuple[Item, bool]]:
        """What is held when nothing comes any more: readings like others, as far as is known."""
        out = [(h[0], False) for h in self._held]
        self.clear()
        return out
