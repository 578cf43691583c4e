"""The calibration of one reading after the other, compiled: `readings.hpp` has the rules.

A `sensors` is an array of `SENSOR`, of which functions without a row take one of a single element.
"""

from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray, StructArray

SENSOR: np.dtype[Any]
LIMITS: np.dtype[Any]
BATCH: np.dtype[Any]

RECENT: int
MAX_HELD: int
COARSE: float
MIN_CHANGES: float
SAME: float
DITHERED: float
MIN_STD: float
TOGGLE: float
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
BLOCK_COMPLETE: int
JUMPED_BACK: int
RESTORABLE: int
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
    """Calibrate a batch of readings, from `next` on, until Python has to do something.

    Parameters
    ----------
    sensors : (n_sensors,) SENSOR
        Changed.
    limits : (1,) LIMITS
    rows, stamps, fields : (n,), (n,) ns, (n, 3) T
        The readings: their sensors (negative: unknown), timestamps and raw fields.
    own, covariances : (n,), (n, 3, 3) T^2
        NONE, VALID or INVALID; read where it is not NONE.
    batches : (1,) BATCH
        Changed.
    out_rows, out_stamps, out_fields, out_covariances
        The calibrated readings are appended from `n_out` on; IndexError: there is no room.

    Returns
    -------
    int
        DONE, or the reason of what `row` and `stamp_ns` are about.
    """

def use_reading(
        sensors: StructArray, limits: StructArray, batches: StructArray, row: int, stamp: int,
        field: FloatArray, own: int, covariance: FloatArray, out_rows: IntArray,
        out_stamps: IntArray, out_fields: FloatArray, out_covariances: FloatArray) -> bool:
    """Calibrate a reading of sensor `row` that has passed; False: a block has to be judged first.

    The arguments are as for `calibrate_readings`.
    """

def subtract(sensors: StructArray, time: float, field: FloatArray, out: FloatArray) -> None:
    """Field without the background at `time` [s]: from `field` (3,) [T] into `out` (3,)."""

def steps_of(sensors: StructArray, are_corrected: bool) -> FloatArray:
    """(3,) [T] steps; 0 where they are too fine to be seen, inf where the axis never changed."""

def complete_steps(variance: FloatArray, steps: FloatArray) -> None:
    """`resolution.completed_steps`, in place."""

def apply_steps(sensors: StructArray, freeze_std: float, limits: FloatArray) -> None:
    """Add what the steps of a sensor do to its noise.

    `noise` is read, `step_variance` and `noise_std` are written, and into `limits` (3,) [T] how far
    the mean of a block may be off: `freeze_std` standard deviations.
    """

def block_moments(sensors: StructArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Of the complete block: as in `blocks.Block`."""

def line_through(time: FloatArray, n: FloatArray, y: FloatArray, centre: float
                 ) -> tuple[FloatArray, FloatArray]:
    """Mean (3,) and slope (3,) at `centre`: `blocks.line_through`."""

def pooled_covariance(scatter: FloatArray, n: FloatArray) -> FloatArray | None:
    """`blocks.pooled_covariance`, of `scatter` (k, 3, 3) and `n` (k, 3)."""

def note_step(sensors: StructArray, stamp: int, raw: FloatArray) -> None:
    """Update the steps of a sensor by a raw reading (3,) [T], and since when each axis rests."""

def is_stuck(sensors: StructArray, field: FloatArray) -> bool:
    """Whether a reading (3,) [T] repeats the one before for longer than chance allows."""

def screen_spike(sensors: StructArray, threshold: float, stamp: int, field: FloatArray) -> int:
    """PASSES, HELD, SPIKE or RELEASED, for a reading without a covariance of its own."""

def collect(sensors: StructArray, time: float, field: FloatArray) -> None:
    """Begin a block where the reading (3,) [T] is the first after the present one, and add it."""
