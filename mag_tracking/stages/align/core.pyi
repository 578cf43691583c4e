"""The alignment of one sample after the other, compiled: `alignment.hpp` has the rules."""

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
    """The samples of a network that wait for their frame.

    Attributes
    ----------
    next, row : int
        The next sample of the batch, and the sensor of the one that a reason is about.
    passed : int, ns
        The newest timestamp that was not ahead of all others, or NEVER.
    is_calm : bool
        Whether no clock has stepped.
    n_pending : int
        How many samples wait.
    """

    next: int
    passed: int
    is_calm: bool
    @property
    def row(self) -> int: ...
    @property
    def n_pending(self) -> int: ...
    def __init__(self, n_sensors: int, period: int, wait: int, limit: int, jump_back: int,
                 most: int, is_burst: bool) -> None:
        """Length of a frame, how long a sensor may be silent, how far ahead a timestamp may be and
        how far back is a restart, all [ns]; how many samples of a sensor may wait; whether sensors
        are read in turn."""

    def hold(self, is_checked: bool, passed: IntArray, rows: IntArray, stamps: IntArray,
             fields: FloatArray, covariances: FloatArray) -> int:
        """Put samples to the pending ones, from `next` on, until Python has to do something.

        Parameters
        ----------
        is_checked : bool
            It is known that the samples are not from clocks that stepped.
        passed : (n_sensors,) ns
            The latest of each sensor's samples that were not ahead of all others; changed.
        rows, stamps, fields, covariances : (n,), (n,) ns, (n, 3) T, (n, 3, 3) T^2
            The samples; rows: their sensors, negative: unknown.

        Returns
        -------
        int
            DONE, or the reason of what `row` is about.
        """

    def frame(self, is_final: bool) -> tuple[int, FloatArray, FloatArray, IntArray,
                                             FloatArray] | None:
        """The next frame if it is complete, or all that is pending is final; else None.

        Timestamp [ns], field, covariance, samples and offsets, as of `records.FieldFrame`.
        """

    def drop(self, i: int) -> None:
        """Without the oldest sample of sensor `i`, where it has one."""

    def waits(self) -> bool:
        """Whether there is a sensor that the next frame has to wait for."""
