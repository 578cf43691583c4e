"""Compiled buffer of raw readings."""

from mag_tracking.arrays import FloatArray, IntArray

def add_readings(rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int, first: int,
                 count: IntArray, stamp: IntArray, received: IntArray, field: FloatArray) -> int:
    """Add readings to the arrays of a buffer.

    Parameters
    ----------
    rows, stamps, fields, received_ns, first
        As for `ReadingBuffer.add`.
    count : (n_sensors,) int array
        Number of buffered readings; updated in place.
    stamp, received : (n_sensors, capacity) int array, ns
        Timestamps and times of receipt; updated in place.
    field : (n_sensors, capacity, 3) array, T
        Readings; updated in place.

    Returns
    -------
    int
        As for `ReadingBuffer.add`.
    """
