"""Raw readings that wait to be looked at: arrays, filled by compiled code.

Who looks at ten thousand readings a second one by one does nothing else.
"""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.records import plain
from mag_tracking.stages.health import core


class ReadingBuffer:
    """Of each of `n` sensors up to `room` readings, in the order in which they came."""

    def __init__(self, n: int, room: int) -> None:
        self._count = np.zeros(n, dtype=np.int64)
        self._stamp, self._received = np.zeros((2, n, room), dtype=np.int64)
        self._field = np.zeros((n, room, 3))

    def add(self, rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int,
            first: int) -> int:
        """Take readings from the one at `first` on, as long as there is room.

        Parameters
        ----------
        rows : (n,) int
            Whose they are; those of negative rows are left out.
        stamps : (n,) int [ns]
        fields : (n, 3) [T]
        received_ns : int
            When they all came.
        first : int

        Returns
        -------
        int
            The first reading there is no room for, until those of its sensor are taken; n if
            there is none.
        """
        return core.add_readings(plain(rows, np.int64), plain(stamps, np.int64), plain(fields),
                                 received_ns, first, self._count, self._stamp, self._received,
                                 self._field)

    def take(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """(stamps (k,) [ns], fields (k, 3) [T], received (k,) [ns]) of sensor `j`; no copies.

        They wait no more: another reading of the sensor takes their place.
        """
        k, self._count[j] = int(self._count[j]), 0
        return self._stamp[j, :k], self._field[j, :k], self._received[j, :k]
