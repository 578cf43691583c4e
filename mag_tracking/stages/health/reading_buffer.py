"""Raw readings that wait to be looked at: arrays, filled by compiled code.

Who looks at ten thousand readings a second one by one does nothing else.
"""

import numpy as np
from numba import float64, int64

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.compiled import compiled_when_used


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
        return _add(rows, stamps, fields, received_ns, first, self._count, self._stamp,
                    self._received, self._field)

    def take(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """(stamps (k,) [ns], fields (k, 3) [T], received (k,) [ns]) of sensor `j`; no copies.

        They wait no more: another reading of the sensor takes their place.
        """
        k, self._count[j] = int(self._count[j]), 0
        return self._stamp[j, :k], self._field[j, :k], self._received[j, :k]


_I, _II = int64[::1], int64[:, ::1]


@compiled_when_used(int64(_I, _I, float64[:, ::1], int64, int64, _I, _II, _II, float64[:, :, ::1]))
def _add(rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int, first: int,
         count: IntArray, stamp: IntArray, received: IntArray, field: FloatArray) -> int:
    """`ReadingBuffer.add`."""
    for i in range(first, len(rows)):
        j = rows[i]
        if j < 0:
            continue
        k = count[j]
        if k == stamp.shape[1]:
            return i
        stamp[j, k], received[j, k] = stamps[i], received_ns
        for a in range(3):
            field[j, k, a] = fields[i, a]
        count[j] = k + 1
    return len(rows)
