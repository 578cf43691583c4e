"""Health of the sensors during a recording, as rows of an archive table."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.network import SensorNetwork
from mag_tracking.results.archive_folder import common_columns
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.units import NS

ROW_INTERVAL_S = 600.0
"""Interval between the rows of a sensor [s]."""


class HealthRows:
    """Creates the rows of the table `health`, at intervals (`due_rows`) or on request (`rows`)."""

    def __init__(self, recording: Path, network: SensorNetwork) -> None:
        self._recording, self._network = recording, network
        self._previous_counts = {name: (0, 0) for name in network.names}
        self._next_ns: int | None = None

    def due_rows(self, stamp_ns: int, calibrate: Calibrate) -> Iterator[dict[str, Any]]:
        """Yield one row per sensor if `ROW_INTERVAL_S` has passed since the previous rows.

        The first interval begins with the first frame. If the time jumps back to before the current
        interval, a new interval begins.
        """
        if self._next_ns is None or stamp_ns < self._next_ns - ROW_INTERVAL_S * NS:
            self._next_ns = stamp_ns + int(ROW_INTERVAL_S * NS)
        if stamp_ns >= self._next_ns:
            self._next_ns = stamp_ns + int(ROW_INTERVAL_S * NS)
            yield from self.rows(stamp_ns, calibrate)

    def rows(self, stamp_ns: int, calibrate: Calibrate) -> Iterator[dict[str, Any]]:
        """Yield one row per sensor, with its accepted and rejected readings since the last row."""
        for name, background in calibrate.backgrounds().items():
            counts = calibrate.counts_of(name)
            previous, total = self._previous_counts[name], (counts['accepted'], counts['rejected'])
            self._previous_counts[name] = total
            covariance = background.covariance
            noise = np.full(3, np.nan) if covariance is None \
                else np.sqrt(np.diagonal(covariance))
            has_background = background.ready and counts['accepted'] > 0
            level = calibrate.background(name) if has_background else np.full(3, np.nan)
            yield {**common_columns(self._recording, stamp_ns), 'sensor': name,
                   'accepted': total[0] - previous[0], 'rejected': total[1] - previous[1],
                   'times_relearnt': background.n_relearnt, 'ready': background.ready,
                   'stuck': background.stuck, 'doubtful': background.doubtful,
                   **{f'{name}_{axis}': float(v)
                      for name, values in (('background', level), ('drift', background.drift),
                                           ('noise', noise))
                      for axis, v in zip('xyz', values, strict=True)}}
