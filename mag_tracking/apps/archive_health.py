"""How the sensors of a recording were, as rows of an archive."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.archive_folder import common_columns
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.units import NS

EVERY_S = 600.0
"""[s] Between the rows of a sensor."""


class HealthRows:
    """Gives a row a sensor every ten minutes, and at the end."""

    def __init__(self, recording: Path, network: SensorNetwork) -> None:
        self._recording, self._network = recording, network
        self._counted = {name: (0, 0) for name in network.names}
        self._next_ns: int | None = None

    def due(self, stamp_ns: int, calibrate: Calibrate) -> Iterator[dict[str, Any]]:
        """The rows at the time of a frame, where ten minutes are over."""
        if self._next_ns is None or stamp_ns < self._next_ns - EVERY_S * NS:
            self._next_ns = stamp_ns + int(EVERY_S * NS)
        if stamp_ns >= self._next_ns:
            self._next_ns = stamp_ns + int(EVERY_S * NS)
            yield from self.rows(stamp_ns, calibrate)

    def rows(self, stamp_ns: int, calibrate: Calibrate) -> Iterator[dict[str, Any]]:
        """A row a sensor."""
        for name, background in calibrate.backgrounds().items():
            counts = calibrate.counts_of(name)
            before, now = self._counted[name], (counts['accepted'], counts['rejected'])
            self._counted[name] = now
            covariance = background.covariance
            noise = np.full(3, np.nan) if covariance is None \
                else np.sqrt(np.diagonal(covariance))
            known = background.ready and counts['accepted'] > 0
            level = calibrate.background(name) if known else np.full(3, np.nan)
            yield {**common_columns(self._recording, stamp_ns), 'sensor': name,
                   'accepted': now[0] - before[0], 'rejected': now[1] - before[1],
                   'times_relearnt': background.n_relearnt, 'ready': background.ready,
                   'stuck': background.stuck, 'doubtful': background.doubtful,
                   **_axes('background', level), **_axes('drift', background.drift),
                   **_axes('noise', noise)}


def _axes(name: str, values: FloatArray) -> dict[str, float | None]:
    """Three columns; None where the value is not known."""
    return {f'{name}_{axis}': None if np.isnan(v) else float(v)
            for axis, v in zip('xyz', values, strict=True)}
