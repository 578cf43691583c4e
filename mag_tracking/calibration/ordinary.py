"""What changes with every reading of a sensor, as arrays, and the compiled way through it.

Of a hundred sensors come ten thousand readings a second, and about nearly all of
them nothing is odd. Those take the compiled way. At the first that is odd it
stops, and Python, which knows all cases, goes on from the same arrays.
"""

from typing import Any, TypeAlias

import numpy as np
from numba import float64, from_dtype, int64, njit, void

from mag_tracking.arrays import FloatArray, IntArray, StructArray

NEVER = np.iinfo(np.int64).min
"""[ns] Stamp of what has not been."""
RECENT = 8
"""Steps from one reading to the next that a spike is compared with."""
LEAST_SAMPLES = 8
"""A block has at least so many readings, however slow the sensor: fewer tell nothing of noise."""
MEMORY = 20_000
"""Readings that the usual repetitions are counted over, about."""

SENSOR = np.dtype([
    # Whether its readings may take the compiled way, and what that needs to know of it then.
    ('is_ordinary', np.int64), ('accepted', np.int64), ('clock_ns', np.int64),
    ('offset', np.float64, 3), ('is_turned', np.int64), ('correction', np.float64, (3, 3)),
    ('centre', np.float64), ('mean', np.float64, 3), ('slope', np.float64, 3),
    ('horizon', np.float64), ('noise_std', np.float64, 3),
    # Its first and latest stamp.
    ('first_ns', np.int64), ('last_ns', np.int64),
    # `screening.Repetition`
    ('last', np.float64, 3), ('run', np.int64), ('repeats', np.float64), ('changes', np.float64),
    # `screening.SpikeFilter`
    ('before_ns', np.int64), ('before', np.float64, 3), ('n_steps', np.int64),
    ('steps', np.float64, (RECENT, 3)),
    # `background.RunningBackground`: how long a block is, by which share the first is longer (NaN
    # where they need not follow each other at even times, and are judged at once), and when the
    # present one ends; which of two is being collected, and whether the other is complete.
    ('length', np.float64), ('phase', np.float64), ('end', np.float64),
    ('now', np.int64), ('is_full', np.int64),
    # Both, from their first reading; of each pair of axes, over the readings that have both.
    ('n', np.int64, 2), ('time', np.float64, 2), ('origin', np.float64, (2, 3)),
    ('count', np.float64, (2, 3, 3)), ('sum', np.float64, (2, 3, 3)),
    ('product', np.float64, (2, 3, 3)),
])
"""State of one sensor, in [T] and [s], or [ns] where the name says so."""

LIMITS = np.dtype([('max_field', np.float64), ('longest_jump_ns', np.float64),
                   ('reject_stuck', np.int64), ('spike_std', np.float64)])
"""What is asked of each reading; as in `CalibrateSettings`."""

_Record: TypeAlias = Any
"""One SENSOR or LIMITS in compiled code, where its fields are attributes; NumPy's types know of no
such."""

_SENSORS, _LIMITS = from_dtype(SENSOR)[::1], from_dtype(LIMITS)[::1]


def new_sensors(n: int) -> StructArray:
    """(n,) SENSOR of which nothing has been heard."""
    sensors = np.zeros(n, SENSOR)
    for name in ('first_ns', 'last_ns', 'before_ns'):
        sensors[name] = NEVER
    for name in ('last', 'before', 'end'):
        sensors[name] = np.nan
    return sensors


@njit(cache=True, inline='always')
def _ends_block(s: _Record, time: float) -> bool:
    """Whether a reading at `time` [s] is the first behind the block that is being collected."""
    is_behind: bool = time >= s.end and s.n[s.now] >= LEAST_SAMPLES
    return is_behind


@njit(cache=True, inline='always')
def _begin_block(s: _Record, time: float) -> None:
    """Collect the next block, from a reading at `time` [s] on."""
    if np.isnan(s.end):
        s.end = time + s.length * (1.0 if np.isnan(s.phase) else 1.0 + s.phase)
        return
    s.now, s.is_full = 1 - s.now, 1
    s.n[s.now] = 0
    if np.isnan(s.phase):
        s.end = time + s.length
    else:
        # By the jitter of their stamps the blocks of all sensors would sooner or later end with
        # the same reading, and once they did so they would for ever.
        s.end += ((time - s.end) // s.length + 1.0) * s.length


@njit(void(_SENSORS, int64, float64, float64[::1]), cache=True)
def add_to_block(sensors: StructArray, j: int, time: float, field: FloatArray) -> None:
    """Take a reading of sensor `j`, `field` (3,) [T] at `time` [s], into its block.

    What was complete before (`is_full`) has to have been used by now.
    """
    s: _Record = sensors[j]
    if np.isnan(s.end) or _ends_block(s, time):
        _begin_block(s, time)
    k = s.now
    if s.n[k] == 0:
        s.time[k] = 0.0
        for a in range(3):
            s.origin[k, a] = np.nan
            for b in range(3):
                s.count[k, a, b] = s.sum[k, a, b] = s.product[k, a, b] = 0.0
    s.n[k] += 1
    s.time[k] += time
    for a in range(3):
        if np.isnan(field[a]):
            continue
        if np.isnan(s.origin[k, a]):
            s.origin[k, a] = field[a]
        d = field[a] - s.origin[k, a]
        for b in range(3):
            if not np.isnan(field[b]):
                # Where it has not been heard before, this reading is the origin of that axis.
                e = 0.0 if np.isnan(s.origin[k, b]) else field[b] - s.origin[k, b]
                s.count[k, a, b] += 1.0
                s.sum[k, a, b] += d
                s.product[k, a, b] += d * e


@njit(cache=True, inline='always')
def _without_iron(raw: FloatArray, offset: FloatArray, is_turned: int, correction: FloatArray,
                  field: FloatArray) -> None:
    """`without_iron`."""
    for a in range(3):
        field[a] = raw[a] - offset[a]
    if is_turned:
        x, y, z = field[0], field[1], field[2]
        for a in range(3):
            field[a] = correction[a, 0] * x + correction[a, 1] * y + correction[a, 2] * z


@njit(void(float64[::1], float64[::1], int64, float64[:, ::1], float64[::1]), cache=True)
def without_iron(raw: FloatArray, offset: FloatArray, is_turned: int, correction: FloatArray,
                 field: FloatArray) -> None:
    """`raw` (3,) [T] without the sensor's own hard and soft iron, into `field`.

    To the last bit the same for all: readings that repeat themselves have to stay alike.
    """
    _without_iron(raw, offset, is_turned, correction, field)


@njit(cache=True, inline='always')
def _is_odd(s: _Record, limits: _Record, stamp: int, raw: FloatArray, field: FloatArray,
            time: float) -> bool:
    """Whether there is anything that Python has to look at."""
    for a in range(3):
        # A comparison with NaN is false: an axis that is missing is odd.
        if not abs(raw[a]) <= limits.max_field:
            return True
    since = stamp - s.last_ns
    if not (0 < since and since <= limits.longest_jump_ns):
        return True
    if s.is_full or np.isnan(s.phase) and _ends_block(s, time):
        return True
    if limits.reject_stuck:
        is_same = field[0] == s.last[0] and field[1] == s.last[1] and field[2] == s.last[2]
        if is_same or s.run > 0 or s.repeats + s.changes + 1.0 > MEMORY:
            return True
    if limits.spike_std > 0.0:
        if s.before_ns == NEVER:
            return True
        for a in range(3):
            if s.n_steps >= RECENT and not (
                    abs(field[a] - s.before[a]) <= limits.spike_std * s.noise_std[a]):
                return True
    return False


@njit(int64(_SENSORS, _LIMITS, int64[::1], int64[::1], float64[:, ::1], int64, int64[::1],
            float64[:, ::1]), cache=True)
def take_ordinary(sensors: StructArray, limits: StructArray, rows: IntArray, stamps: IntArray,
                  fields: FloatArray, first: int, out_stamps: IntArray,
                  out_fields: FloatArray) -> int:
    """Calibrate readings from the one at `first` on, as long as there is nothing odd about them.

    Parameters
    ----------
    sensors : (n_sensors,) SENSOR
        Changed.
    limits : (1,) LIMITS
    rows : (n,) int
        Whose the readings are; negative = odd.
    stamps : (n,) int [ns]
    fields : (n, 3) [T]
        As the sensors gave them.
    first : int
    out_stamps, out_fields : (n,) [ns], (n, 3) [T]
        Where the readings of the same rows are put: by the network's clock and without the
        background.

    Returns
    -------
    int
        The first reading that is odd, which nothing was done with; n if there is none.
    """
    limit: _Record = limits[0]
    field = np.empty(3)
    for i in range(first, len(rows)):
        if rows[i] < 0 or not sensors[rows[i]].is_ordinary:
            return i
        s: _Record = sensors[rows[i]]
        stamp = stamps[i] - s.clock_ns
        time = (stamp - s.first_ns) / 1e9
        _without_iron(fields[i], s.offset, s.is_turned, s.correction, field)
        if _is_odd(s, limit, stamp, fields[i], field, time):
            return i
        s.last_ns = stamp
        s.accepted += 1
        if limit.reject_stuck:
            s.changes += 1.0
        since = min(time, s.horizon) - s.centre
        place = s.n_steps % RECENT
        for a in range(3):
            s.last[a] = field[a]
            s.steps[place, a] = abs(field[a] - s.before[a])
            s.before[a] = field[a]
            out_fields[i, a] = field[a] - s.mean[a] - since * s.slope[a]
        s.before_ns = stamp
        s.n_steps += 1
        add_to_block(sensors, rows[i], time, field)
        out_stamps[i] = stamp
    return len(rows)
