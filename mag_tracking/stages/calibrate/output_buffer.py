"""Room for the calibrated readings of one batch."""

import numpy as np

from mag_tracking.records import Readings


class OutputBuffer:
    """Arrays that compiled code appends calibrated readings to."""

    def __init__(self, names: tuple[str, ...], room: int) -> None:
        """`names` of all sensors; at most `room` readings."""
        self._names = names
        self.arrays = (np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64),
                       np.empty((room, 3)), np.empty((room, 3, 3)))
        """Sensors (room,), timestamps (room,) [ns], fields (room, 3) [T], covariances
        (room, 3, 3) [T^2]."""

    def readings(self, n: int) -> list[Readings]:
        """The first `n` readings, in one batch; none: no batch."""
        rows, stamps, fields, covariances = self.arrays
        return [Readings(self._names, rows[:n], stamps[:n], fields[:n], covariances[:n])] \
            if n else []
