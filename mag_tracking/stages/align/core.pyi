"""Compiled alignment of individual samples, by the rules in `alignment.hpp`."""

from mag_tracking.arrays import FloatArray, IntArray

DONE: int
UNKNOWN_SENSOR: int
NO_FIELD: int
NO_COVARIANCE: int
DUPLICATE: int
OUT_OF_ORDER: int
LATE: int
JUMPED_BACK: int
CLOCK_STEP: int
TOO_MANY: int
COMPLETE: int

class Alignment:
    """Queues the pending samples of a network and combines them into frames.

    Parameters
    ----------
    n_sensors : int
    period : int, ns
        Length of a frame.
    wait : int, ns
        Maximum time for which frames wait for a silent sensor.
    limit : int, ns
        A larger forward jump of a timestamp is reported as CLOCK_STEP.
    jump_back : int, ns
        A larger backward jump of a timestamp is reported as JUMPED_BACK.
    most : int
        Maximum number of pending samples per sensor.
    is_burst : bool
        Whether the sensors are read sequentially.

    Attributes
    ----------
    next : int
        Index of the next sample of the batch.
    row : int
        Index of the sensor that the latest reason refers to.
    passed : int, ns
        Newest timestamp that passed the clock step filter, or NEVER.
    is_calm : bool
        Whether no clock step is suspected, so that samples within `limit` bypass the clock step
        filter.
    n_pending : int
        Number of pending samples.
    """

    next: int
    passed: int
    is_calm: bool
    @property
    def row(self) -> int: ...
    @property
    def n_pending(self) -> int: ...
    def __init__(self, n_sensors: int, period: int, wait: int, limit: int, jump_back: int,
                 most: int, is_burst: bool) -> None: ...
    def hold(self, is_checked: bool, passed: IntArray, rows: IntArray, stamps: IntArray,
             fields: FloatArray, covariances: FloatArray) -> int:
        """Queue samples, starting at `next`, until an event must be handled.

        Parameters
        ----------
        is_checked : bool
            Whether the samples have passed the clock step filter.
        passed : (n_sensors,) int array, ns
            Latest timestamp of each sensor that passed the clock step filter; updated in place.
        rows : (n,) int array
            Index of the sensor of each sample; negative for an unknown sensor.
        stamps : (n,) int array, ns
        fields : (n, 3) array, T
        covariances : (n, 3, 3) array, T^2

        Returns
        -------
        int
            Reason code: DONE, or an event of sensor `row`.
        """

    def frame(self, is_final: bool) -> tuple[int, FloatArray, FloatArray, IntArray,
                                             FloatArray] | None:
        """Remove the samples of the next frame from the queue and return the frame.

        Parameters
        ----------
        is_final : bool
            Whether the input has ended, so that incomplete frames are returned too.

        Returns
        -------
        tuple or None
            Timestamp [ns], field, covariance, number of samples and time offset, as in
            `records.FieldFrame`. None if there is no such frame.
        """

    def drop(self, i: int) -> None:
        """Drop the oldest pending sample of sensor `i`, if there is one."""

    def waits(self) -> bool:
        """Whether the next frame must wait for a sensor."""
