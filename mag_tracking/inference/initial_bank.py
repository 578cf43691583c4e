"""Compact copy of a filter bank at its start, before target and sensor states are correlated.

Smoothing and relinearisation restart at the beginning of a track. Storing the full covariances of
all hypotheses would require as much memory as the bank.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank


@dataclass
class InitialBank:
    """Hypotheses of a `FilterBank` at its start, on the first axis of every array."""

    x: FloatArray
    """States of the target, then of the sensors, (n_hyp, n_x)."""
    P: FloatArray
    """Covariances of the target states, (n_hyp, n_t, n_t)."""
    P_sensors: FloatArray
    """Covariance of the sensor states, common to all hypotheses, (n_x - n_t, n_x - n_t)."""
    label: IntArray
    """As `FilterBank.label`."""
    kind: IntArray
    """As `FilterBank.kind`."""
    origin: IntArray
    """As `FilterBank.origin`."""
    n_sensors: int
    """Number of sensors."""

    @classmethod
    def of(cls, bank: FilterBank, n_target: int) -> 'InitialBank':
        """Copy a bank before its first update; its first `n_target` states are those of the
        target."""
        return cls(bank.x.copy(), bank.P[:, :n_target, :n_target].copy(),
                   bank.P[0, n_target:, n_target:].copy(), bank.label, bank.kind, bank.origin,
                   bank.nis.shape[1])

    def __len__(self) -> int:
        """Number of hypotheses."""
        return len(self.x)

    def rows(self, rows: IntArray) -> FilterBank:
        """Restore the hypotheses of the given indices, as copies with equal weights."""
        n, n_t = len(rows), self.P.shape[1]
        P = np.zeros((n, self.x.shape[1], self.x.shape[1]))
        P[:, :n_t, :n_t], P[:, n_t:, n_t:] = self.P[rows], self.P_sensors
        return FilterBank(self.x[rows], P, np.full(n, -np.log(n)), self.label[rows],
                          self.kind[rows], self.origin[rows], np.full((n, self.n_sensors), np.nan))

    def keep(self, mask: BoolArray) -> None:
        """Keep the hypotheses selected by `mask` (n_hyp,)."""
        for name in ('x', 'P', 'label', 'kind', 'origin'):
            setattr(self, name, getattr(self, name)[mask])
