"""Output buffer for the calibrated readings of one batch."""

import numpy as np

from mag_tracking.records import Readings


class OutputBuffer:
    """Arrays to which compiled code appends calibrated readings.

    Parameters
    ----------
    names : tuple of str
        Names of all sensors.
    capacity : int
        Maximum number of readings.

    Attributes
    ----------
    arrays : tuple of arrays
        Sensor indices (capacity,), timestamps (capacity,) ns, fields (capacity, 3) T and
        covariances (capacity, 3, 3) T².
    """

    def __init__(self, names: tuple[str, ...], capacity: int) -> None:
        self._names = names
        self.arrays = (np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64),
                       np.empty((capacity, 3)), np.empty((capacity, 3, 3)))

    def readings(self, n: int) -> list[Readings]:
        """Return the first `n` readings.

        Parameters
        ----------
        n : int
            Number of readings that have been appended.

        Returns
        -------
        list of Readings
            One batch, or an empty list if `n` is 0.
        """
        rows, stamps, fields, covariances = self.arrays
        return [Readings(self._names, rows[:n], stamps[:n], fields[:n], covariances[:n])] \
            if n else []
