"""The alignment of one sample after the other, compiled.

Every rule for a sample stands here once. What needs Python (a rejection that is counted by name, a
clock that stepped, a frame that may be complete, ...) is returned as a reason code.
"""

import numpy as np
from numba import boolean, float64, from_dtype, int64, njit, void

from mag_tracking.arrays import FloatArray, IntArray, Record, StructArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.units import NEVER

(DONE, UNKNOWN_SENSOR, NO_FIELD, NO_COVARIANCE, DUPLICATE, OUT_OF_ORDER, LATE) = range(7)
"""The batch is finished, or the sample is rejected."""
NO_ROOM, JUMPED_BACK = range(10, 12)
"""To be handled before the same sample is taken again."""
CLOCK_STEP, TOO_MANY, COMPLETE = range(20, 23)
"""The sample may be from a clock that stepped, and nothing was done with it; the sensor has more
samples pending than allowed; the next frame may be complete."""

CLOCK = np.dtype([(name, np.int64) for name in (
    'first', 'newest', 'end', 'start', 'due', 'window', 'watch', 'passed', 'is_calm', 'next', 'row',
    'period', 'wait', 'limit', 'most', 'jump_back', 'is_burst')])
"""[ns] Oldest and newest timestamp; end of the latest frame; earliest start of the next one, and
when it ends; its length; a sensor that the next frame has to wait for, or -1; newest timestamp that
was not ahead of all others; whether no clock has stepped; the next sample of the batch, and the
sensor of the one that a reason is about. Settings:
length of a frame, how long a sensor may be silent, how far ahead a timestamp may be, how many
samples of a sensor may be pending, how far back is a restart; whether sensors are read in turn."""

CLOCKS = from_dtype(CLOCK)[::1]
_I, _II = int64[::1], int64[:, ::1]
_V, _M = float64[:, ::1], float64[:, :, ::1]


@njit()
def _is_behind(c: Record, latest: int) -> bool:
    """Whether a sensor is alive, and may still give a sample of before the end of the frame."""
    if latest == NEVER:
        return bool(c.newest - c.first < c.wait)
    return bool(c.newest - c.wait <= latest and latest < c.due)


@njit()
def _is_one_behind(c: Record, latest: IntArray) -> bool:
    """Whether there is one; it is watched from now on, until it is behind no more."""
    if c.watch >= 0 and _is_behind(c, latest[c.watch]):
        return True
    for j in range(len(latest)):
        if _is_behind(c, latest[j]):
            c.watch = j
            return True
    return False


@compiled_when_used(boolean(CLOCKS, _I))
def is_one_behind(clocks: StructArray, latest: IntArray) -> bool:
    """Whether the next frame has to wait for a sensor; `latest` (n_sensors,) [ns] timestamps."""
    return bool(_is_one_behind(clocks[0], latest))


@njit()
def _bring_forward(c: Record, stamp: int, taken: int) -> None:
    """`bring_forward`."""
    if c.is_burst:
        # A round spreads over the period, or half of any sensor's sample interval.
        if taken != NEVER:
            c.window = min(c.window, max(1, (stamp - taken) // 2))
    elif c.end != NEVER and stamp < c.end + c.period:
        stamp = c.end
    c.start = min(c.start, stamp)
    c.due = c.start + c.window


@compiled_when_used(void(CLOCKS, int64, int64))
def bring_forward(clocks: StructArray, stamp: int, taken: int) -> None:
    """Have the next frame end early enough for the oldest pending sample of a sensor.

    Parameters
    ----------
    clocks : (1,) CLOCK
        Changed.
    stamp : int, ns
        Of that sample.
    taken : int, ns
        Timestamp of the sensor's latest sample in a frame, or NEVER.
    """
    _bring_forward(clocks[0], stamp, taken)


@njit()
def _fault(field: FloatArray, covariance: FloatArray) -> int:
    """Why a sample cannot be used, or DONE."""
    n_missing = 0
    for a in range(3):
        if np.isinf(field[a]):
            return NO_FIELD
        n_missing += np.isnan(field[a])
    if n_missing == 3:
        return NO_FIELD
    for a in range(3):
        for b in range(3):
            if not np.isnan(covariance[a, b]):
                return DONE
    return NO_COVARIANCE


@njit()
def _place(c: Record, latest: IntArray, i: int, stamp: int) -> int:
    """Why the timestamp of a sample of sensor `i` cannot be used, or DONE."""
    last = latest[i]
    if last != NEVER and stamp <= last:
        if last - stamp > c.jump_back:
            return JUMPED_BACK
        return DUPLICATE if stamp == last else OUT_OF_ORDER
    latest[i] = stamp
    if stamp < c.end:
        return LATE
    c.first = stamp if c.newest == NEVER else min(c.first, stamp)
    c.newest = max(c.newest, stamp)
    return DONE


@njit()
def _store(fields: FloatArray, covariances: FloatArray, i: int, place: int, field: FloatArray,
           covariance: FloatArray) -> None:
    """Put a field (3,) and its covariance (3, 3) to a place of sensor `i`.

    Numba would take two seconds to compile the text of the error of a slice that does not fit.
    """
    for a in range(3):
        fields[i, place, a] = field[a]
        for b in range(3):
            covariances[i, place, a, b] = covariance[a, b]


@compiled_when_used(
    int64(CLOCKS, boolean, _I, _I, _I, _I, _I, _II, _M, float64[:, :, :, ::1], _I, _I, _V, _M))
def hold_samples(clocks: StructArray, is_checked: bool, latest: IntArray, passed: IntArray,
                 taken: IntArray, first: IntArray, count: IntArray, stamp: IntArray,
                 field: FloatArray, covariance: FloatArray, rows: IntArray, stamps: IntArray,
                 fields: FloatArray, covariances: FloatArray) -> int:
    """Put samples to the pending ones, from `next` on, until Python has to do something.

    Parameters
    ----------
    clocks : (1,) CLOCK
        Changed, as the next arrays.
    is_checked : bool
        It is known that the samples are not from clocks that stepped.
    latest, passed, taken : (n_sensors,) ns
        Latest timestamp of each sensor; that of its samples that were not ahead of all others;
        that of its samples in frames.
    first, count, stamp, field, covariance
        `SampleBuffer`.
    rows, stamps, fields, covariances : (n,), (n,) ns, (n, 3) T, (n, 3, 3) T^2
        The samples; rows: their sensors, negative: unknown.

    Returns
    -------
    int
        DONE, or the reason code of what `row` is about.
    """
    c, room = clocks[0], stamp.shape[1]
    while c.next < len(rows):
        k = c.next
        i, t = rows[k], stamps[k]
        c.row = i
        if i >= 0 and count[i] == room:
            return NO_ROOM
        c.next = k + 1
        if i < 0:
            return UNKNOWN_SENSOR
        reason = _fault(fields[k], covariances[k])
        if reason != DONE:
            return reason
        if not is_checked:
            if not c.is_calm or c.passed != NEVER and t - c.passed > c.limit:
                return CLOCK_STEP
            passed[i] = t
            c.passed = max(c.passed, t)
        reason = _place(c, latest, i, t)
        if reason == JUMPED_BACK:
            c.next = k
        if reason != DONE:
            return reason
        if count[i] == 0:
            _bring_forward(c, t, taken[i])
        place = (first[i] + count[i]) % room
        stamp[i, place] = t
        _store(field, covariance, i, place, fields[k], covariances[k])
        count[i] += 1
        if count[i] > c.most:
            return TOO_MANY
        if c.is_burst or c.due < 0 or not _is_one_behind(c, latest):
            return COMPLETE
    return DONE
