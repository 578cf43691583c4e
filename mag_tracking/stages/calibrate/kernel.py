"""The calibration of one reading after the other, compiled.

Every rule for a reading stands here once. What needs Python (a rejection that is counted by name, a
block to be judged, a clock that jumped back, ...) is returned as a reason code, and the kernel
continues where it stopped.
"""

import numpy as np
from numba import boolean, float64, from_dtype, int64, njit

from mag_tracking.arrays import FloatArray, IntArray, Record, StructArray
from mag_tracking.calibration.background_level import subtract_background
from mag_tracking.calibration.blocks import begin_block_if_due, collect
from mag_tracking.calibration.resolution import note_step, rest_of
from mag_tracking.calibration.screening import (
    HELD,
    PASSES,
    RELEASED,
    SPIKE,
    is_stuck,
    screen_spike,
)
from mag_tracking.calibration.sensor_state import SENSORS
from mag_tracking.compiled import compiled_when_used
from mag_tracking.units import NEVER

(DONE, UNKNOWN_SENSOR, NO_AXIS, INFINITE, TOO_LARGE, BAD_COVARIANCE, AXIS_MISSING, TOO_FAR_AHEAD,
 DUPLICATE, OUT_OF_ORDER, STUCK) = range(11)
"""The batch is finished, or the reading is rejected."""
BLOCK_COMPLETE, JUMPED_BACK, RESTORABLE = range(20, 23)
"""To be handled before the same reading is taken again."""
SPIKES, PASSED = range(30, 32)
"""The `n_spikes` readings before are rejected, or the `n_released` held readings are to be used."""

MOST_ALIKE = 0.7
"""The correlation of two axes that a message states may differ by this from the measured one."""

NONE, VALID, INVALID = range(3)
"""Whether a reading has its own covariance."""

LIMITS = np.dtype([('max_field', np.float64), ('longest_jump_ns', np.float64),
                   ('jump_back_ns', np.float64), ('reject_stuck', np.int64),
                   ('spike_std', np.float64), ('is_decimated', np.int64),
                   ('trust_covariances', np.int64)])
"""As in `CalibrateSettings`."""

CREDIBLE = 25.0
"""The variance that a message states is used where it differs from the measured one by less than
this factor."""

BATCH = np.dtype([(name, np.int64) for name in (
    'next', 'row', 'n_out', 'n_spikes', 'n_learning', 'n_partly_learning', 'n_overruled')] + [
    ('stamp_ns', np.int64)])
"""Progress within a batch: the next reading; sensor and timestamp of the one that a reason is
about; how many calibrated readings there are; how many were spikes; of how many the background, or
that of one axis, is not known yet; of how many the covariance was overruled."""

_LIMITS, _BATCH = from_dtype(LIMITS)[::1], from_dtype(BATCH)[::1]
_I, _V, _M = int64[::1], float64[:, ::1], float64[:, :, ::1]


@njit()
def _fault(limits: Record, raw: FloatArray, own: int) -> int:
    """Why a raw reading cannot be used, or DONE."""
    largest, is_known = 0.0, False
    for a in range(3):
        if not np.isnan(raw[a]):
            largest, is_known = max(largest, abs(raw[a])), True
    if not is_known:
        return NO_AXIS
    if np.isinf(largest):
        return INFINITE
    if largest > limits.max_field:
        return TOO_LARGE
    return BAD_COVARIANCE if own == INVALID and limits.trust_covariances else DONE


@njit()
def _remove_iron(s: Record, raw: FloatArray, field: FloatArray) -> bool:
    """Remove the sensor's own hard and soft iron: from `raw` into `field`; False: no axis is left.

    An axis that the correction needs and that is missing makes those missing that need it.
    """
    is_known = False
    for a in range(3):
        field[a] = raw[a] - s.offset[a]
    if s.has_correction:
        x, y, z = field[0], field[1], field[2]
        for a in range(3):
            c = s.correction[a]
            if np.isnan(x) or np.isnan(y) or np.isnan(z):
                # A coefficient of zero needs no axis.
                field[a] = (0.0 if c[0] == 0.0 else c[0] * x) \
                    + (0.0 if c[1] == 0.0 else c[1] * y) + (0.0 if c[2] == 0.0 else c[2] * z)
            else:
                field[a] = c[0] * x + c[1] * y + c[2] * z
    for a in range(3):
        is_known |= not np.isnan(field[a])
    return is_known


@njit()
def _misplaced(s: Record, limits: Record, stamp: int) -> int:
    """Why a timestamp cannot be used, or DONE."""
    if s.last_ns != NEVER:
        if stamp - s.last_ns > limits.longest_jump_ns:
            before = s.unconfirmed_ns
            if before == NEVER or not 0 < stamp - before <= limits.longest_jump_ns:
                s.unconfirmed_ns = stamp
                return TOO_FAR_AHEAD
        else:
            s.unconfirmed_ns = NEVER
        if stamp <= s.last_ns:
            if s.last_ns - stamp > limits.jump_back_ns:
                return JUMPED_BACK
            return DUPLICATE if stamp == s.last_ns else OUT_OF_ORDER
    if s.is_restorable:
        return RESTORABLE
    s.last_ns = stamp
    if s.first_ns == NEVER:
        s.first_ns = stamp
    return DONE


@njit()
def _check(s: Record, limits: Record, stamp: int, raw: FloatArray, own: int,
           field: FloatArray) -> int:
    """Why a reading cannot be used, or is not used yet, or DONE; without iron it is in `field`."""
    if s.is_full:
        return BLOCK_COMPLETE
    reason = _fault(limits, raw, own)
    if reason != DONE:
        return reason
    if not _remove_iron(s, raw, field):
        return AXIS_MISSING
    reason = _misplaced(s, limits, stamp)
    if reason != DONE:
        return reason
    return STUCK if limits.reject_stuck and is_stuck(s, field) else DONE


@njit()
def _screen(s: Record, limits: Record, batch: Record, stamp: int, field: FloatArray, own: int,
            covariance: FloatArray, steps: FloatArray) -> int:
    """`screen_spike`, with the number of spikes noted."""
    if limits.spike_std <= 0.0:
        return PASSES
    verdict = screen_spike(s, limits.spike_std, stamp, field, own, covariance, steps)
    if verdict == SPIKE:
        batch.n_spikes += s.n_held
        s.n_held = 0
        verdict = screen_spike(s, limits.spike_std, stamp, field, own, covariance, steps)
    return verdict


@njit()
def _queue(s: Record, stamp: int, field: FloatArray, own: int, covariance: FloatArray) -> None:
    """Store a reading that passes and cannot be used before Python has done something."""
    s.n_held = s.n_released = 1
    s.held_ns[0], s.held_own[0] = stamp, own
    for a in range(3):
        s.held_field[0, a] = field[a]
        for b in range(3 if own else 0):
            s.held_covariance[0, a, b] = covariance[a, b]


@njit()
def _is_credible(s: Record, covariance: FloatArray) -> bool:
    """Whether the covariance of a message agrees with the noise of the sensor."""
    for a in range(3):
        stated, known = covariance[a, a], s.noise[a, a] + s.step_variance[a]
        # A comparison with NaN is false: an axis that is missing contradicts nothing.
        if stated > CREDIBLE * known or known > CREDIBLE * stated:
            return False
        for b in range(a):
            # Axes that are said to err together, and do not.
            both = np.sqrt(stated * covariance[b, b])
            if abs(covariance[a, b] / both - s.noise[a, b] / np.sqrt(
                    known * (s.noise[b, b] + s.step_variance[b]))) > MOST_ALIKE:
                return False
    return True


@njit()
def _attach_covariance(s: Record, limits: Record, batch: Record, own: int,
                       covariance: FloatArray, out: FloatArray) -> None:
    """Covariance of a reading: its own where that is credible, else that of the sensor.

    Either with that of a provisional background.
    """
    if own and not limits.trust_covariances and (
            own == INVALID or not _is_credible(s, covariance)):
        own = NONE
        s.n_overruled += 1
        batch.n_overruled += 1
        for a in range(3):
            s.stated_std[a] = np.sqrt(covariance[a, a]) if covariance[a, a] >= 0.0 else np.nan
    for a in range(3):
        for b in range(3):
            out[a, b] = covariance[a, b] if own else s.noise[a, b]
        if not (own and limits.trust_covariances):
            out[a, a] += s.step_variance[a] * rest_of(s, a) / s.n_averaged
        out[a, a] += s.level_variance[a]


@njit()
def _use(s: Record, limits: Record, batch: Record, row: int, stamp: int, field: FloatArray,
         own: int, covariance: FloatArray, out_rows: IntArray, out_stamps: IntArray,
         out_fields: FloatArray, out_covariances: FloatArray) -> bool:
    """Calibrate a reading; False if a block has to be judged first."""
    time = (stamp - s.first_ns) / 1e9
    begin_block_if_due(s, time)
    if s.is_full and np.isnan(s.phase):
        return False
    collect(s, time, field)
    if not s.is_ready:
        batch.n_learning += 1
        return True
    k = batch.n_out
    if k >= len(out_rows):
        raise IndexError('no room for the calibrated readings')
    out, C = out_fields[k], out_covariances[k]
    subtract_background(s, time, field, out)
    _attach_covariance(s, limits, batch, own, covariance, C)
    n_missing, is_new = 0, False
    for a in range(3):
        # An axis that has only just begun to report: nothing is known of it yet.
        is_unknown = not np.isnan(field[a]) and (np.isnan(out[a]) or not C[a, a] > 0.0)
        is_new |= is_unknown
        if is_unknown:
            out[a] = np.nan
            C[a, :] = C[:, a] = np.nan
        n_missing += np.isnan(out[a])
    batch.n_partly_learning += is_new
    if n_missing < 3:
        out_rows[k], out_stamps[k] = row, stamp
        batch.n_out += 1
    return True


@njit()
def _correct_covariance(s: Record, C: FloatArray, out: FloatArray) -> None:
    """Covariance `C` (3, 3) of a raw reading after the soft-iron correction, into `out`."""
    if not s.has_correction:
        for a in range(3):
            for b in range(3):
                out[a, b] = C[a, b]
        return
    for a in range(3):
        for b in range(3):
            out[a, b] = 0.0
            for c in range(3):
                for d in range(3):
                    # A coefficient of zero needs no axis, as in `_remove_iron`.
                    weight = s.correction[a, c] * s.correction[b, d]
                    if weight != 0.0:
                        out[a, b] += weight * C[c, d]


@compiled_when_used(int64(SENSORS, _LIMITS, _I, _I, _V, _I, _M, _BATCH, _I, _I, _V, _M))
def calibrate_readings(sensors: StructArray, limits: StructArray, rows: IntArray,
                       stamps: IntArray, fields: FloatArray, own: IntArray,
                       covariances: FloatArray, batches: StructArray, out_rows: IntArray,
                       out_stamps: IntArray, out_fields: FloatArray,
                       out_covariances: FloatArray) -> int:
    """Calibrate a batch of readings, from `next` on, until Python has to do something.

    Parameters
    ----------
    sensors : (n_sensors,) SENSOR
        Changed.
    limits : (1,) LIMITS
    rows, stamps, fields : (n,), (n,) ns, (n, 3) T
        The readings: their sensors (negative: unknown), timestamps and raw fields.
    own, covariances : (n,), (n, 3, 3) T^2
        NONE, VALID or INVALID; read where it is VALID.
    batches : (1,) BATCH
        Changed.
    out_rows, out_stamps, out_fields, out_covariances
        The calibrated readings are appended from `n_out` on.

    Returns
    -------
    int
        DONE, or the reason code of what `row` and `stamp_ns` are about.
    """
    limit, batch = limits[0], batches[0]
    field, steps, C = np.empty(3), np.empty(3), np.empty((3, 3))
    while batch.next < len(rows):
        i = batch.next
        batch.row = rows[i]
        batch.next = i + 1
        if rows[i] < 0:
            return UNKNOWN_SENSOR
        s = sensors[rows[i]]
        stamp = batch.stamp_ns = stamps[i] - s.clock_offset_ns
        reason = _check(s, limit, stamp, fields[i], own[i], field)
        if reason != DONE:
            batch.next = i if reason >= BLOCK_COMPLETE else i + 1
            return reason
        if own[i]:
            _correct_covariance(s, covariances[i], C)
        verdict = _screen(s, limit, batch, stamp, field, own[i], C, steps)
        if verdict == PASSES or verdict == RELEASED:
            # A spike is no step of the sensor.
            note_step(s, stamp, fields[i])
        if verdict == PASSES:
            s.accepted += 1
            if not limit.is_decimated and _use(s, limit, batch, rows[i], stamp, field, own[i], C,
                                               out_rows, out_stamps, out_fields, out_covariances):
                if batch.n_spikes:
                    return SPIKES
                continue
            _queue(s, stamp, field, own[i], C)
        elif verdict != HELD:
            s.accepted += s.n_released
        if s.n_released:
            return PASSED
        if batch.n_spikes:
            return SPIKES
    return DONE


@compiled_when_used(
    boolean(SENSORS, _LIMITS, _BATCH, int64, int64, float64[::1], int64, float64[:, ::1], _I, _I,
    _V, _M))
def use_reading(sensors: StructArray, limits: StructArray, batches: StructArray, row: int,
                stamp: int, field: FloatArray, own: int, covariance: FloatArray, out_rows: IntArray,
                out_stamps: IntArray, out_fields: FloatArray,
                out_covariances: FloatArray) -> bool:
    """Calibrate a reading of sensor `row` that has passed; False: a block has to be judged first.

    The arguments are as for `calibrate_readings`.
    """
    return bool(_use(sensors[row], limits[0], batches[0], row, stamp, field, own, covariance,
                     out_rows, out_stamps, out_fields, out_covariances))
