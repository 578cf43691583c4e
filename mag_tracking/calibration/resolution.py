"""Resolution of a sensor: the steps of its readings, and the error that they add to the noise.

Where the steps are larger than the noise, a reading stays the same while the field moves by up to a
step. Averaging does not remove that error, and a reading that repeats the one before adds little.
"""

import numpy as np
from numba import float64, njit, void

from mag_tracking.arrays import FloatArray, Record, StructArray
from mag_tracking.calibration.sensor_state import SENSORS
from mag_tracking.compiled import compiled_when_used
from mag_tracking.records import plain

SAME = 3e-7
"""Values that differ by a smaller share than this differ by rounding only: single precision."""

DITHERED = 0.3
"""Noise of a larger variance, in squared steps, carries a reading over several steps, and averaging
works. A reading that toggles between two steps has a variance of 0.25 at most."""

LEAST_STD = 1e-11
"""[T] An axis that scatters less has not changed at all."""

TOGGLE = 1.2
"""[steps] An axis that rests on one value may rest on the next one a moment later."""

REPEATS = 0.2
"""An axis whose steps are larger than its noise stays the same more often than this, for each
change."""

LONGEST_REST_NS = 300_000_000
"""Readings that stay the same for longer count as several measurements, one in each such time."""


@njit()
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
            continue
        # A comparison with NaN is false: the first reading changes nothing. Only a rest that has
        # ended counts: an axis that hangs rests for ever.
        if change >= 0.0:
            s.n_same[a] += s.n_rest[a] - 1
            s.n_changed[a] += 1
            s.step[a] = min(s.step[a], change)
        s.raw[a], s.rest_since_ns[a], s.n_rest[a] = value, stamp, 1


@njit()
def _seen_step(s: Record, a: int) -> float:
    """Step [T] of raw axis `a`; 0 where it is too fine to be seen.

    The smallest change is the step of an axis that repeats itself. A field that moves with every
    reading has a smallest change, too.
    """
    return s.step[a] if s.n_same[a] >= REPEATS * s.n_changed[a] else 0.0


@njit()
def _corrected_steps(s: Record, out: FloatArray) -> None:
    """Steps of the axes after the soft-iron correction, into `out` (3,)."""
    for a in range(3):
        if not s.has_correction:
            out[a] = _seen_step(s, a)
            continue
        total, is_known = 0.0, False
        for b in range(3):
            step = _seen_step(s, b)
            if s.correction[a, b] != 0.0 and np.isfinite(step):
                total += (s.correction[a, b] * step)**2
                is_known = True
        out[a] = np.sqrt(total) if is_known else np.inf


@njit()
def rest_of(s: Record, a: int) -> float:
    """For how many readings axis `a` rests, after the correction: the raw axes count by what their
    steps add.
    """
    if not s.has_correction:
        return float(s.n_rest[a])
    total = weighted = 0.0
    for b in range(3):
        if np.isfinite(s.step[b]):
            weight = (s.correction[a, b] * s.step[b])**2
            total += weight
            weighted += weight * s.n_rest[b]
    return weighted / total if total > 0.0 else 1.0


@compiled_when_used(float64[::1](SENSORS))
def corrected_steps(sensors: StructArray) -> FloatArray:
    """Steps of a sensor's axes after the soft-iron correction.

    Parameters
    ----------
    sensors : (1,) SENSOR

    Returns
    -------
    (3,) array, T
        0 where they are too fine to be seen, inf where the axis has never changed.
    """
    out = np.empty(3)
    _corrected_steps(sensors[0], out)
    return out


@compiled_when_used(float64[::1](SENSORS))
def raw_steps(sensors: StructArray) -> FloatArray:
    """As `corrected_steps`, before the correction."""
    out = np.empty(3)
    for a in range(3):
        out[a] = _seen_step(sensors[0], a)
    return out


@njit()
def _rests(variance: float, step: float) -> bool:
    """Whether a step [T] is larger than a noise of this variance [T^2], which may be NaN."""
    return bool(variance <= DITHERED * step**2)


@njit()
def _complete(variance: FloatArray, steps: FloatArray) -> None:
    """`completed_steps`, in place."""
    largest, is_known = 0.0, False
    for a in range(3):
        if np.isfinite(steps[a]) and not np.isnan(variance[a]):
            is_known = True
            if _rests(variance[a], steps[a]):
                largest = max(largest, steps[a])
    for a in range(3):
        if is_known and np.isinf(steps[a]) and not np.isnan(variance[a]):
            steps[a] = largest if largest > 0.0 else np.nan


def completed_steps(variance: FloatArray, steps: FloatArray) -> FloatArray:
    """Steps of all axes; one that is not known yet is that of the others if those rest, too.

    An axis that has never changed is dead where another one of the same sensor changes with every
    reading. It may rest where none has changed so far.

    Parameters
    ----------
    variance : (3,) array, T^2
        Scatter of quiet readings; NaN = missing axis.
    steps : (3,) array, T
        As of `corrected_steps`.

    Returns
    -------
    (3,) array, T
        NaN of a dead axis; inf where none has changed.
    """
    out = plain(steps).copy()
    _complete(plain(variance), out)
    return out


@compiled_when_used(void(SENSORS, float64, float64[::1]))
def apply_steps(sensors: StructArray, freeze_std: float, limits: FloatArray) -> None:
    """Add what the steps of a sensor do to its noise.

    Parameters
    ----------
    sensors : (1,) SENSOR
        `noise` is read, `step_variance` and `noise_std` are written.
    freeze_std : float
        A block departs from the background if its mean is this many standard deviations off.
    limits : (3,) array, T
        Written: how far the mean of a block may be off.
    """
    s = sensors[0]
    steps, variance = np.empty(3), np.empty(3)
    for a in range(3):
        variance[a] = s.noise[a, a]
    _corrected_steps(s, steps)
    for a in range(3):
        # An axis without any noise rests, also where it has moved with a target since.
        if steps[a] == 0.0 and variance[a] <= LEAST_STD**2:
            steps[a] = max(s.step[0], s.step[1], s.step[2])
    _complete(variance, steps)
    for a in range(3):
        rests = np.isfinite(steps[a]) and _rests(variance[a], steps[a])
        if not rests and variance[a] <= LEAST_STD**2 and s.step_variance[a] > 0.0:
            # Another axis is louder now. This one rests as before.
            continue
        s.step_variance[a] = steps[a]**2 / 12.0 if rests else 0.0
        s.noise_std[a] = np.sqrt(variance[a] + s.step_variance[a])
        limits[a] = freeze_std * s.noise_std[a]
        if rests:
            limits[a] = max(limits[a], TOGGLE * steps[a])


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
