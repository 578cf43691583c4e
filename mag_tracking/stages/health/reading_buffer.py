"""Buffer of raw readings, filled by compiled code.

Processing ten thousand readings per second individually in Python would occupy a whole core.
"""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.records import plain
from mag_tracking.stages.health import core


class ReadingBuffer:
    """Buffer for the raw readings of `n` sensors, in order of arrival for each sensor.

    `capacity` is the maximum number of readings per sensor.
    """

    def __init__(self, n: int, capacity: int) -> None:
        self._count = np.zeros(n, dtype=np.int64)
        self._stamp, self._received = np.zeros((2, n, capacity), dtype=np.int64)
        self._field = np.zeros((n, capacity, 3))

    def add(self, rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int,
            first: int) -> int:
        """Add readings from index `first` until a buffer is full; return the next index.

        `rows` are the sensors' indices; readings with a negative index are skipped. All readings
        were received at `received_ns`.
        """
        return core.add_readings(plain(rows, np.int64), plain(stamps, np.int64), plain(fields),
                                 received_ns, first, self._count, self._stamp, self._received,
                                 self._field)

    def pop(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """Remove and return the timestamps, fields and times of receipt of sensor `j`.

        The returned arrays are views, which the next readings of the sensor overwrite.
        """
        out = self.peek(j)
        self._count[j] = 0
        return out

    def peek(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """Return the readings of a sensor, as `pop`, and keep them in the buffer."""
        k = int(self._count[j])
        return self._stamp[j, :k], self._field[j, :k], self._received[j, :k]
