"""Output buffer for the calibrated readings of one batch."""

from collections import Counter

import numpy as np

from mag_tracking.arrays import Record
from mag_tracking.records import Readings

OVERRULED = 'message covariances overruled by the measured noise'
"""Key in the counts for message covariances that were replaced by the measured noise."""
COUNTED = {'held back while learning': 'n_learning',
           'axes held back while learning': 'n_partly_learning', OVERRULED: 'n_overruled'}
"""{key in the counts: counter of a batch}."""


class OutputBuffer:
    """Arrays for calibrated readings: sensor indices (n,), timestamps (n,) [ns], fields (n, 3) [T],
    and covariances (n, 3, 3) [T²]; resets the counters of `batch`."""

    def __init__(self, names: tuple[str, ...], capacity: int, batch: Record) -> None:
        self._names, self._batch = names, batch
        for name in ('n_out', *COUNTED.values()):
            batch[name] = 0
        self.arrays = (np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64),
                       np.empty((capacity, 3)), np.empty((capacity, 3, 3)))

    def finish(self, counts: 'Counter[str]') -> list[Readings]:
        """Return the appended readings as one batch, if any, and count them in `counts`."""
        n = int(self._batch['n_out'])
        for key, name in (('calibrated', 'n_out'), *COUNTED.items()):
            if self._batch[name]:
                counts[key] += int(self._batch[name])
        rows, stamps, fields, covariances = self.arrays
        return [Readings(self._names, rows[:n], stamps[:n], fields[:n], covariances[:n])] \
            if n else []
