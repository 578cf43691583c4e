"""Calibration of readings one by one, compiled; the rules are in `readings.hpp`.

`sensors` is an array of `SENSOR`. Functions without an argument `row` or `rows` require an array
with a single element.
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

    Parameters
    ----------
    sensors : (n_sensors,) SENSOR array
        Updated.
    limits : (1,) LIMITS array
    rows : (n,) int array
        Index of the sensor of each reading; negative if unknown.
    stamps : (n,) int array, ns
    fields : (n, 3) array, T
        Raw fields.
    own : (n,) int array
        State of the covariance in the message: NONE, VALID or INVALID.
    covariances : (n, 3, 3) array, T²
        Ignored where `own` is NONE.
    batches : (1,) BATCH array
        Updated.
    out_rows : (m,) int array
        Output: index of the sensor of each calibrated reading.
    out_stamps : (m,) int array, ns
        Output: timestamps.
    out_fields : (m, 3) array, T
        Output: fields minus the background.
    out_covariances : (m, 3, 3) array, T²
        Output: noise covariances. All outputs are appended from `n_out` on.

    Returns
    -------
    int
        DONE, or the reason for stopping; `row` and `stamp_ns` of the batch identify the reading.

    Raises
    ------
    IndexError
        If an output array is full, or the index of a sensor is out of range.
    """

def use_reading(
        sensors: StructArray, limits: StructArray, batches: StructArray, row: int, stamp: int,
        field: FloatArray, own: int, covariance: FloatArray, out_rows: IntArray,
        out_stamps: IntArray, out_fields: FloatArray, out_covariances: FloatArray) -> bool:
    """Calibrate a reading that has passed the screening.

    Parameters
    ----------
    sensors : (n_sensors,) SENSOR array
        Updated.
    limits : (1,) LIMITS array
    batches : (1,) BATCH array
        Updated.
    row : int
        Index of the sensor.
    stamp : int, ns
    field : (3,) array, T
        Field after the iron correction.
    own : int
        State of the covariance in the message: NONE, VALID or INVALID.
    covariance : (3, 3) array, T²
        Covariance in the message; ignored if `own` is NONE.
    out_rows : (m,) int array
        As for `calibrate_readings`.
    out_stamps : (m,) int array, ns
        As for `calibrate_readings`.
    out_fields : (m, 3) array, T
        As for `calibrate_readings`.
    out_covariances : (m, 3, 3) array, T²
        As for `calibrate_readings`.

    Returns
    -------
    bool
        False if a complete block must be evaluated first; the reading has not been used then.
    """

def subtract(sensors: StructArray, time: float, field: FloatArray, out: FloatArray) -> None:
    """Subtract the background from a field.

    Parameters
    ----------
    sensors : (1,) SENSOR array
    time : float, s
    field : (3,) array, T
    out : (3,) array, T
        Overwritten.
    """

def steps_of(sensors: StructArray, are_corrected: bool) -> FloatArray:
    """Quantisation steps of the axes of a sensor.

    Parameters
    ----------
    sensors : (1,) SENSOR array
    are_corrected : bool
        Whether to apply the soft-iron correction to the steps.

    Returns
    -------
    (3,) array, T
        0 if the steps are too fine to be observed, inf if the axis has never changed.
    """

def complete_steps(variance: FloatArray, steps: FloatArray) -> None:
    """Complete unknown steps in place; see `sensor_state.completed_steps`.

    Parameters
    ----------
    variance : (3,) array, T²
        Noise variance of each axis; NaN for a missing axis.
    steps : (3,) array, T
        Updated.
    """

def apply_steps(sensors: StructArray, freeze_std: float, limits: FloatArray) -> None:
    """Add the quantisation variance of a sensor to its noise.

    Reads `noise`; writes `step_variance` and `noise_std`.

    Parameters
    ----------
    sensors : (1,) SENSOR array
        Updated.
    freeze_std : float
        Number of standard deviations of the noise in `limits`.
    limits : (3,) array, T
        Overwritten: maximum difference between the mean of a block and the background.
    """

def block_moments(sensors: StructArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Attributes of `blocks.Block` for the latest complete block.

    Parameters
    ----------
    sensors : (1,) SENSOR array

    Returns
    -------
    time : float, s
    mean : (3,) array, T
    scatter : (3, 3) array, T²
    n : (3,) array
    """

def line_through(time: FloatArray, n: FloatArray, y: FloatArray, centre: float
                 ) -> tuple[FloatArray, FloatArray]:
    """Weighted least-squares line of each axis; see `blocks.line_through`.

    Parameters
    ----------
    time : (k,) array, s
        Mean time of each block.
    n : (k, 3) array
        Number of readings of each block, per axis.
    y : (k, 3) array, T
        Mean of each block.
    centre : float, s
        Time at which the mean is evaluated.

    Returns
    -------
    mean : (3,) array, T
    slope : (3,) array, T/s
    """

def pooled_covariance(scatter: FloatArray, n: FloatArray) -> FloatArray | None:
    """Noise covariance from the scatter within blocks; see `blocks.pooled_covariance`.

    Parameters
    ----------
    scatter : (k, 3, 3) array, T²
        Sum of squared deviations of each block.
    n : (k, 3) array
        Number of readings of each block, per axis.

    Returns
    -------
    (3, 3) array or None, T²
    """

def note_step(sensors: StructArray, stamp: int, raw: FloatArray) -> None:
    """Update the quantisation steps and the time of the latest change of each axis.

    Parameters
    ----------
    sensors : (1,) SENSOR array
        Updated.
    stamp : int, ns
    raw : (3,) array, T
        Raw reading; NaN for a missing axis.
    """

def is_stuck(sensors: StructArray, field: FloatArray) -> bool:
    """Record a reading, and return whether its repetitions are too many to be due to chance.

    Parameters
    ----------
    sensors : (1,) SENSOR array
        Updated.
    field : (3,) array, T
        Reading; NaN for a missing axis.

    Returns
    -------
    bool
    """

def screen_spike(sensors: StructArray, threshold: float, stamp: int, field: FloatArray) -> int:
    """Classify a reading without its own covariance.

    Parameters
    ----------
    sensors : (1,) SENSOR array
        Updated.
    threshold : float
        Minimum magnitude of a spike in standard deviations of the noise.
    stamp : int, ns
    field : (3,) array, T
        Reading; NaN for a missing axis.

    Returns
    -------
    int
        PASSES, HELD, SPIKE or RELEASED.
    """

def collect(sensors: StructArray, time: float, field: FloatArray) -> None:
    """Add a reading to the current block; if that block has ended, start the next block first.

    Parameters
    ----------
    sensors : (1,) SENSOR array
        Updated.
    time : float, s
    field : (3,) array, T
        Reading; NaN for a missing axis.
    """
