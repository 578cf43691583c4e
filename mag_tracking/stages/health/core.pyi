"""The buffer of raw readings, compiled."""

from mag_tracking.arrays import FloatArray, IntArray

def add_readings(rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int, first: int,
                 count: IntArray, stamp: IntArray, received: IntArray, field: FloatArray) -> int:
    """`ReadingBuffer.add`; `count` (n_sensors,), `stamp` and `received` (n_sensors, room) and
    `field` (n_sensors, room, 3) are changed."""
