"""A bank as it starts: what is known of the target and of the sensors has nothing in common yet.

Smoothing and relinearising begin where a track began. To keep the covariances of all its
hypotheses would take as much memory as the bank.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank


@dataclass
class InitialBank:
    """The hypotheses of a `FilterBank` at its start; every array has the hypothesis as first axis.
    """

    x: FloatArray
    """(n_hyp, n_x) states: of the target, then of the sensors."""
    P: FloatArray
    """(n_hyp, n_t, n_t) covariances of the target's."""
    P_sensors: FloatArray
    """(n_x - n_t, n_x - n_t) covariance of the sensors', of any hypothesis."""
    label: IntArray
    kind: IntArray
    origin: IntArray
    n_sensors: int

    @classmethod
    def of(cls, bank: FilterBank, n_target: int) -> 'InitialBank':
        """A copy of a bank whose first `n_target` states are of the target."""
        return cls(bank.x.copy(), bank.P[:, :n_target, :n_target].copy(),
                   bank.P[0, n_target:, n_target:].copy(), bank.label, bank.kind, bank.origin,
                   bank.nis.shape[1])

    def __len__(self) -> int:
        return len(self.x)

    def rows(self, rows: IntArray) -> FilterBank:
        """A bank of the hypotheses `rows` (n,) int, weighted alike; its arrays are its own."""
        n, n_t = len(rows), self.P.shape[1]
        P = np.zeros((n, self.x.shape[1], self.x.shape[1]))
        P[:, :n_t, :n_t], P[:, n_t:, n_t:] = self.P[rows], self.P_sensors
        return FilterBank(self.x[rows], P, np.full(n, -np.log(n)), self.label[rows],
                          self.kind[rows], self.origin[rows], np.full((n, self.n_sensors), np.nan))

    def keep(self, mask: BoolArray) -> None:
        """Keep the hypotheses of the `mask` (n_hyp,)."""
        for name in ('x', 'P', 'label', 'kind', 'origin'):
            setattr(self, name, getattr(self, name)[mask])
