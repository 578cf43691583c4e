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

    A frame has the length `period` [ns], and waits for a silent sensor for at most `wait` [ns].
    Timestamps that jump forward by more than `limit` or backward by more than `jump_back` [ns] are
    reported as CLOCK_STEP or JUMPED_BACK; `most` is the maximum number of pending samples per
    sensor.
    """

    next: int
    """Index of the next sample of the batch."""
    passed: int
    """Newest timestamp that passed the clock step filter [ns], or NEVER."""
    is_calm: bool
    """Whether samples within `limit` bypass the clock step filter."""
    @property
    def row(self) -> int:
        """Index of the sensor that the latest reason refers to."""
    @property
    def n_pending(self) -> int: ...
    def __init__(self, n_sensors: int, period: int, wait: int, limit: int, jump_back: int,
                 most: int, is_burst: bool) -> None: ...
    def hold(self, is_checked: bool, passed: IntArray, rows: IntArray, stamps: IntArray,
             fields: FloatArray, covariances: FloatArray) -> int:
        """Queue n samples, starting at `next`, until an event must be handled; return its reason.

        Unless the samples have passed the clock step filter (`is_checked`), they update `passed`
        (n_sensors,), the latest timestamps that have. Unknown sensors have negative `rows`.
        """

    def frame(self, is_final: bool) -> tuple[int, FloatArray, FloatArray, IntArray,
                                             FloatArray] | None:
        """Remove the next frame, even if incomplete at the end of the input (`is_final`), from the
        queue; return its entries in the order of `records.FieldFrame`."""

    def drop(self, i: int) -> None:
        """Drop the oldest pending sample of sensor `i`, if there is one."""

    def waits(self) -> bool:
        """Whether the next frame must wait for a sensor."""
