"""Buffer of raw readings, filled by compiled code.

Processing ten thousand readings per second individually in Python would occupy a whole core.
"""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.records import plain
from mag_tracking.stages.health import core


class ReadingBuffer:
    """Buffer for the raw readings of several sensors, in order of arrival for each sensor.

    Parameters
    ----------
    n : int
        Number of sensors.
    capacity : int
        Maximum number of readings per sensor.
    """

    def __init__(self, n: int, capacity: int) -> None:
        self._count = np.zeros(n, dtype=np.int64)
        self._stamp, self._received = np.zeros((2, n, capacity), dtype=np.int64)
        self._field = np.zeros((n, capacity, 3))

    def add(self, rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int,
            first: int) -> int:
        """Add readings, starting at index `first`, until the buffer of a sensor is full.

        Parameters
        ----------
        rows : (n,) int array
            Index of the sensor of each reading; readings with a negative index are skipped.
        stamps : (n,) int array, ns
        fields : (n, 3) array, T
        received_ns : int, ns
            Time of receipt of all readings.
        first : int
            Index of the first reading to add.

        Returns
        -------
        int
            Index of the first reading whose sensor has a full buffer; n if all were added.
        """
        return core.add_readings(plain(rows, np.int64), plain(stamps, np.int64), plain(fields),
                                 received_ns, first, self._count, self._stamp, self._received,
                                 self._field)

    def pop(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """Remove the readings of a sensor from the buffer and return them.

        The returned arrays are views, which the next readings of the sensor overwrite.

        Parameters
        ----------
        j : int
            Index of the sensor.

        Returns
        -------
        stamps : (k,) int array, ns
        fields : (k, 3) array, T
        received : (k,) int array, ns
        """
        out = self.peek(j)
        self._count[j] = 0
        return out

    def peek(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """Return the readings of a sensor, as `pop`, and keep them in the buffer.

        Parameters
        ----------
        j : int
            Index of the sensor.

        Returns
        -------
        stamps : (k,) int array, ns
        fields : (k, 3) array, T
        received : (k,) int array, ns
        """
        k = int(self._count[j])
        return self._stamp[j, :k], self._field[j, :k], self._received[j, :k]
