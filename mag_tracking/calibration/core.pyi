"""Calibration of readings one by one, compiled; the rules are in `readings.hpp`.

`sensors` is an array of `SENSOR`. Functions without an argument `row` or `rows` require an array
with a single element. Structured arrays are updated.
"""

from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray, StructArray

SENSOR: np.dtype[Any]
LIMITS: np.dtype[Any]
BATCH: np.dtype[Any]

N_RECENT: int
MAX_HELD: int
N_WINDOW: int
MAX_MARKS: int
COARSE_FRACTION: float
MIN_CHANGES: float
MAX_ROUNDING: float
DITHERED: float
MIN_STD: float
TOGGLE_TOLERANCE: float
MAX_REST_NS: int

DONE: int
UNKNOWN_SENSOR: int
NO_AXIS: int
INFINITE: int
TOO_LARGE: int
BAD_COVARIANCE: int
AXIS_MISSING: int
TOO_FAR_AHEAD: int
DUPLICATE: int
OUT_OF_ORDER: int
STUCK: int
MARKED: int
REPEATED: int
BLOCK_COMPLETE: int
JUMPED_BACK: int
RESTORABLE: int
WINDOW_COMPLETE: int
SPIKES: int
PASSED: int

NONE: int
VALID: int
INVALID: int

PASSES: int
HELD: int
SPIKE: int
RELEASED: int

def calibrate_readings(
        sensors: StructArray, limits: StructArray, rows: IntArray, stamps: IntArray,
        fields: FloatArray, own: IntArray, covariances: FloatArray, batches: StructArray,
        out_rows: IntArray, out_stamps: IntArray, out_fields: FloatArray,
        out_covariances: FloatArray) -> int:
    """Calibrate the readings of a batch from index `next` on, until Python must handle a case.

    `rows` (n,) are the indices of the sensors, negative if unknown, `stamps` (n,) in ns, `fields`
    (n, 3) in T raw, `own` (n,) the states of the covariances (n, 3, 3) in T² of the messages: NONE
    (ignored), VALID or INVALID. Calibrated readings (m, ...) are appended to the outputs from
    `n_out` on: indices of sensors, timestamps, fields minus the background, noise covariances.
    `limits` and `batches` have one element. Returns DONE, or the reason for stopping; `row` and
    `stamp_ns` of the batch identify the reading. Raises IndexError if an output array is full, or
    the index of a sensor is out of range.
    """

def use_reading(
        sensors: StructArray, limits: StructArray, batches: StructArray, row: int, stamp: int,
        field: FloatArray, own: int, covariance: FloatArray, out_rows: IntArray,
        out_stamps: IntArray, out_fields: FloatArray, out_covariances: FloatArray) -> bool:
    """Calibrate a reading (3,) T, after the iron correction, that has passed the screening.

    The other arguments are those of `calibrate_readings`. False if a complete block must be
    evaluated first; the reading has not been used then.
    """

def subtract(sensors: StructArray, time: float, field: FloatArray, out: FloatArray) -> None:
    """Subtract the background at `time` in s from a field (3,) T, into `out` (3,)."""

def steps_of(sensors: StructArray, are_corrected: bool) -> FloatArray:
    """`sensor_state.corrected_steps`, or those of the raw readings unless `are_corrected`."""

def complete_steps(variance: FloatArray, steps: FloatArray) -> None:
    """`sensor_state.completed_steps` in place."""

def apply_steps(sensors: StructArray, freeze_std: float, limits: FloatArray) -> None:
    """Add the quantisation variance of a sensor to its noise: reads `noise`; writes
    `step_variance`, `noise_std` and `limits` (3,) T, the maximum difference between the mean of a
    block and the background, of `freeze_std` standard deviations of the noise."""

def block_moments(sensors: StructArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Attributes of `blocks.Block` for the latest complete block."""

def line_through(time: FloatArray, n: FloatArray, y: FloatArray, centre: float
                 ) -> tuple[FloatArray, FloatArray]:
    """`blocks.line_through` without the `centre` [s] that it computes."""

def pooled_covariance(scatter: FloatArray, n: FloatArray) -> FloatArray | None:
    """Return `blocks.pooled_covariance`."""

def note_step(sensors: StructArray, stamp: int, raw: FloatArray) -> None:
    """Update the quantisation steps and the time of the latest change of each axis with a raw
    reading (3,) T at `stamp` in ns."""

def is_stuck(sensors: StructArray, field: FloatArray) -> bool:
    """Record a reading (3,) T, and return whether its repetitions are too many to be due to
    chance."""

def screen_spike(sensors: StructArray, threshold: float, stamp: int, field: FloatArray) -> int:
    """Classify a reading (3,) T without its own covariance as PASSES, HELD, SPIKE or RELEASED;
    `threshold` is the minimum magnitude of a spike in standard deviations of the noise."""

def collect(sensors: StructArray, time: float, field: FloatArray) -> None:
    """Add a reading (3,) T to the current block; if that block has ended, start the next block
    first."""
