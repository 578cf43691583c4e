"""Faulty readings of one sensor: spikes, and a sensor that is stuck; compiled.

Only a suspect reading is held until the next ones decide; all others pass at once.
"""

import math

import numpy as np
from numba import njit

from mag_tracking.arrays import FloatArray, Record
from mag_tracking.calibration.sensor_state import MOST_HELD, RECENT
from mag_tracking.units import NEVER

MEMORY = 20_000
"""Readings over which the usual share of repetitions is counted, about."""
LEAST_CHANGES = 50
"""A sensor that has changed less often may have steps so coarse that it repeats itself for long."""
LIKELY = math.log(1e-9)
"""A run of equal readings is a fault where chance makes it no more often than this."""
SHORTEST_RUN = 4
COARSE = 0.05
"""A sensor that repeats itself more often has steps so coarse that at rest it may do so for ever;
with a noise of one step or more, on three axes, the share is below this."""
STEEPER = 8.0
"""A spike is steeper than the steepest recent difference by this factor, and by more where readings
are rare."""
FASTEST = 30.0
"""[1/s] Highest speed of a target, in units of its distance: 30 m/s at one metre."""
LARGEST_OF_RECENT = 2.4
"""Largest of `RECENT` differences between readings of white noise, in its standard deviations; the
mean."""
STEEPEST = 130.0
"""A dipole that moves by the share s of its distance between two readings, s above 0.4, makes a
difference steeper than the ones before by less than this times s^3, in 99.9 % of the cases
(simulated)."""
COARSEST = 1.5e-6
"""[T] Steps of magnetometers are hardly larger than this. With the usual threshold steps of up to
1.3e-5 T do not make a spike by it."""
BACK = 0.3
"""After a spike the field is again where it was, to this share of the spike."""

PASSES, HELD, SPIKE, RELEASED = range(4)
"""Results of `screen_spike`: the reading passes; it is held; what was held is a spike (call
again for the reading itself); the held readings and this one pass, in order."""


@njit()
def _is_too_long(s: Record) -> bool:
    """Whether the present run of equal readings is longer than chance makes it."""
    if s.run < SHORTEST_RUN or s.changes < LEAST_CHANGES:
        return False
    usual = (s.repeats + 1.0) / (s.repeats + s.changes + 2.0)
    return bool(usual < COARSE and s.run * math.log(usual) < LIKELY)


@njit()
def is_stuck(s: Record, field: FloatArray) -> bool:
    """Whether a reading repeats the one before for longer than chance, or coarse steps, allow.

    Parameters
    ----------
    s : SENSOR
        Changed.
    field : (3,) array, T
        NaN = missing axis.
    """
    is_same = True
    for a in range(3):
        if not (field[a] == s.last[a] or np.isnan(field[a]) and np.isnan(s.last[a])):
            is_same = False
        s.last[a] = field[a]
    if is_same:
        s.run += 1
        return bool(_is_too_long(s))
    # A run that is a fault says little about what is usual. But if it counted for nothing, a sensor
    # with coarse steps that started while a target passed would be stuck at rest.
    if s.run:
        s.repeats += 1.0 if _is_too_long(s) else float(s.run)
        s.run = 0
    s.changes += 1.0
    if s.repeats + s.changes > MEMORY:
        s.repeats, s.changes = 0.5 * s.repeats, 0.5 * s.changes
    return False


@njit()
def _largest_recent(s: Record, a: int) -> float:
    """Largest recent difference [T] of axis `a` between readings; NaN if none is known."""
    largest, is_known = 0.0, False
    for k in range(RECENT):
        if not np.isnan(s.steps[k, a]):
            largest, is_known = max(largest, s.steps[k, a]), True
    return largest if is_known else np.nan


@njit()
def _usual_noise(s: Record, a: int) -> float:
    """Standard deviation [T] of axis `a`; before the noise is known, from recent differences."""
    if s.is_ready:
        return float(s.noise_std[a])
    # An axis that has only rested so far has steps like the others.
    step = s.step[a] if s.step[a] < math.inf else min(s.step[0], s.step[1], s.step[2], COARSEST)
    return float(max(_largest_recent(s, a) / LARGEST_OF_RECENT, step / math.sqrt(12.0)))


@njit()
def _is_off(s: Record, threshold: float, stamp: int, steps: FloatArray) -> bool:
    """Whether `steps` (3,) [T] from the reading before are steeper than any target makes them."""
    # A comparison with NaN is false: a missing axis is no spike.
    is_high = False
    for a in range(3):
        is_high |= steps[a] > threshold * _usual_noise(s, a)
    if not is_high:
        return False
    passed = FASTEST * (stamp - s.before_ns) * 1e-9
    steeper = max(STEEPER, STEEPEST * passed**3)
    for a in range(3):
        noise, largest = _usual_noise(s, a), _largest_recent(s, a)
        # A sensor with coarse steps may not have changed at all recently. A comparison with NaN is
        # false: of an axis without recent differences nothing is known.
        if largest >= 0.0 and steps[a] > threshold * noise and steps[a] > steeper * noise \
                and steps[a] > steeper * largest:
            return True
    return False


@njit()
def _hold(s: Record, stamp: int, field: FloatArray, steps: FloatArray, own: int,
          covariance: FloatArray) -> None:
    """Append a reading to those that are held."""
    k = s.n_held
    s.held_ns[k], s.held_own[k] = stamp, own
    for a in range(3):
        s.held_field[k, a], s.held_steps[k, a] = field[a], steps[a]
        if own:
            for b in range(3):
                s.held_covariance[k, a, b] = covariance[a, b]
    s.n_held += 1


@njit()
def _pass(s: Record, stamp: int, field: FloatArray, steps: FloatArray, has_steps: bool) -> None:
    """Note a reading that passes; the next one is compared with it."""
    place = s.n_steps % RECENT
    for a in range(3):
        s.before[a] = field[a]
        if has_steps:
            s.steps[place, a] = steps[a]
    s.before_ns = stamp
    s.n_steps += has_steps


@njit()
def _is_back(s: Record, steps: FloatArray) -> bool:
    """Whether the field is again where it was before the held readings."""
    # The axis in which they are highest decides.
    axis, highest = 0, -1.0
    for a in range(3):
        largest = 0.0
        for k in range(s.n_held):
            if s.held_steps[k, a] > largest:
                largest = s.held_steps[k, a]
        if largest > highest:
            axis, highest = a, largest
    return bool(steps[axis] <= BACK * highest)


@njit()
def screen_spike(s: Record, threshold: float, stamp: int, field: FloatArray, own: int,
                 covariance: FloatArray, steps: FloatArray) -> int:
    """Decide on a reading and on those that are held before it.

    A reading is held where it differs from the one before by more than `threshold` noise
    deviations and by `STEEPER` times more than readings did recently: a vehicle approaches
    smoothly. Where readings are so rare that a target may pass between them, only a steeper
    difference is suspect.

    Parameters
    ----------
    s : SENSOR
        Changed. Before the noise is known (not `is_ready`), recent differences are its measure.
    threshold : float
        In noise deviations.
    stamp : int, ns
    field : (3,) array, T
    own, covariance
        Stored with a held reading: whether it has its own covariance (3, 3), T^2.
    steps : (3,) array, T
        Scratch memory.

    Returns
    -------
    int
        PASSES, HELD, SPIKE (the `n_held` readings are a spike: reject them and call again) or
        RELEASED (`n_released` readings pass, this one is the last).
    """
    if s.before_ns == NEVER:
        if s.n_held:
            _hold(s, stamp, field, steps, own, covariance)
            s.n_released = s.n_held
        _pass(s, stamp, field, steps, False)
        return RELEASED if s.n_held else PASSES
    for a in range(3):
        steps[a] = abs(field[a] - s.before[a])
    if s.n_held:
        if _is_back(s, steps):
            return SPIKE
        _hold(s, stamp, field, steps, own, covariance)
        if s.n_held <= MOST_HELD:
            return HELD
        # A step: the differences before it say nothing of what is usual now.
        s.n_steps, s.n_released = 0, s.n_held
        _pass(s, stamp, field, steps, False)
        return RELEASED
    if s.n_steps >= RECENT and _is_off(s, threshold, stamp, steps):
        _hold(s, stamp, field, steps, own, covariance)
        return HELD
    _pass(s, stamp, field, steps, True)
    return PASSES


def clear_spikes(sensor: Record) -> None:
    """Forget the readings before, and those that are held."""
    sensor['before_ns'], sensor['n_steps'] = NEVER, 0
    sensor['n_held'] = sensor['n_released'] = 0
