"""Resolution of a sensor: the steps of its readings, and the error that they add to the noise.

Where the steps are larger than the noise, a reading stays the same while the field moves by up to a
step. Averaging does not remove that error, and a reading that repeats the one before adds little.
"""

import numpy as np
from numba import njit

from mag_tracking.arrays import BoolArray, FloatArray, Record

SAME = 3e-7
"""Values that differ by a smaller share than this differ by rounding only: single precision."""

DITHERED = 0.3
"""Noise of a larger variance, in squared steps, carries a reading over several steps, and averaging
works. A reading that toggles between two steps has a variance of 0.25 at most."""

REPEATS = 0.2
"""An axis whose steps are larger than its noise stays the same more often than this, for each
change."""

ROUNDING = 1e-6
"""Share of the largest value that single precision and the arithmetic of a driver may add."""

REMAINDER = 2e-5
"""The same of a remainder: each division multiplies it."""

FINEST = 1e-8
"""[T] Finer steps are below the noise of every sensor that rests."""

LONGEST_REST_NS = 300_000_000
"""Readings that stay the same for longer count as several measurements, one in each such time."""


@njit(cache=True)
def note_step(s: Record, stamp: int, raw: FloatArray) -> None:
    """Update the steps of a sensor, and since when each axis rests on one value.

    Parameters
    ----------
    s : SENSOR
        Changed.
    stamp : int, ns
    raw : (3,) array, T
        As the sensor measured it; NaN = missing axis.
    """
    for a in range(3):
        value, before = raw[a], s.raw[a]
        if np.isnan(value):
            continue
        change = abs(value - before)
        if change <= SAME * abs(value) and stamp >= s.rest_since_ns[a]:
            if stamp - s.rest_since_ns[a] <= LONGEST_REST_NS:
                s.n_rest[a] += 1
            s.n_same[a] += 1
            continue
        # A comparison with NaN is false: the first reading changes nothing.
        if change >= 0.0:
            s.n_changed[a] += 1
            s.step[a] = min(s.step[a], change)
        s.raw[a], s.rest_since_ns[a], s.n_rest[a] = value, stamp, 1


def seen_steps(sensor: np.void) -> FloatArray:
    """(3,) [T] steps of the raw axes of a SENSOR; 0 where they are too fine to be seen.

    The smallest change is the step of an axis that repeats itself. A field that moves with every
    reading has a smallest change, too.
    """
    is_seen = sensor['n_same'] >= REPEATS * sensor['n_changed']
    return np.where(is_seen, sensor['step'], 0.0)


def resting(variance: FloatArray, step: FloatArray) -> BoolArray:
    """Whether the steps of each axis are larger than its noise, so that it rests on one value.

    Parameters
    ----------
    variance : (3,) array, T^2
        Scatter of quiet readings; NaN = missing axis.
    step : (3,) array, T
        inf = the axis has never changed.
    """
    with np.errstate(invalid='ignore'):
        return np.asarray(variance <= DITHERED * np.square(step))


def completed_steps(variance: FloatArray, step: FloatArray) -> FloatArray:
    """(3,) [T] steps; one that is not known yet is that of the other axes if those rest, too.

    An axis that has never changed is dead (NaN) where another one of the same sensor changes with
    every reading. It may rest (inf) where none has changed so far.

    The parameters are as for `resting`.
    """
    known = np.isfinite(step) & ~np.isnan(variance)
    unknown = np.isinf(step) & ~np.isnan(variance)
    if not unknown.any() or not known.any():
        return step
    rests = known & resting(variance, step)
    return np.where(unknown, step[rests].max() if rests.any() else np.nan, step)


def common_step(values: FloatArray) -> float:
    """Largest step of which all values are whole multiples.

    Parameters
    ----------
    values : (n,) array, T
        Of the axes of one sensor at one time; NaN = missing.

    Returns
    -------
    float, T
        The step of the sensor, or a multiple of it. inf with fewer than two values, or where they
        have no common step above `FINEST`: the driver has corrected them.
    """
    sizes = np.sort(np.abs(values[np.isfinite(values) & (values != 0.0)]))
    if len(sizes) < 2:
        return float('inf')
    step, largest = float(sizes[0]), float(sizes[-1])
    for size in sizes[1:].tolist():
        while size > REMAINDER * largest:
            # The nearest multiple: the remainder of one just below the next would be all of a step.
            step, size = size, abs(step - round(step / size) * size)
    step = largest / round(largest / step)
    off = np.abs(sizes - step * np.round(sizes / step))
    return step if step >= FINEST and off.max() <= ROUNDING * largest else float('inf')


def smallest_steps(fields: FloatArray) -> FloatArray:
    """Smallest change between consecutive readings of each axis.

    Parameters
    ----------
    fields : (n, 3) array, T
        In order of time; NaN = missing.

    Returns
    -------
    (3,) array, T
        inf where an axis has never changed.
    """
    out = np.full(3, np.inf)
    for axis, values in enumerate(fields.T):
        values = values[~np.isnan(values)]
        change = np.abs(np.diff(values))
        change = change[change > SAME * np.abs(values[1:])]
        out[axis] = change.min(initial=np.inf)
    return out
