"""Compiled buffer of raw readings."""

from mag_tracking.arrays import FloatArray, IntArray

def add_readings(rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int, first: int,
                 count: IntArray, stamp: IntArray, received: IntArray, field: FloatArray) -> int:
    """Add readings to the arrays of a buffer in place, as `ReadingBuffer.add`: the numbers `count`
    (n_sensors,), `stamp` and `received` (n_sensors, capacity) [ns], and `field`
    (n_sensors, capacity, 3) [T]."""
