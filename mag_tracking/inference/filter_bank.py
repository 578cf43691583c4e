"""Bank of filters: hypotheses as arrays, with logarithmic weights.

The bank follows T10 section 2.6 and Alg. 3. Weights are stored as logarithms because two hypotheses
may differ by thousands of nats.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference import core

_NEGLIGIBLE_LOG_RATIO = np.log(100.0)
"""[nats] Log-weight difference from the heaviest hypothesis of those that `best` ignores."""
_SINGULAR_TOLERANCE = 1e-15
"""Fraction of the largest variance that counts as zero, as in `numpy.linalg.pinv`."""


def log_sum_exp(a: ArrayLike) -> float:
    """log(sum(exp(a))) without overflow."""
    a = np.asarray(a, dtype=float)
    top = float(np.max(a))
    top = top if np.isfinite(top) else 0.0
    with np.errstate(divide='ignore'):
        return float(np.log(np.sum(np.exp(a - top))) + top)


@dataclass
class FilterBank:
    """Hypotheses of one target, or of several targets with a joint state, on the first axis."""

    x: FloatArray
    """States, (n_hyp, n_x)."""
    P: FloatArray
    """Covariances, (n_hyp, n_x, n_x)."""
    log_w: FloatArray
    """Normalised log-weights, (n_hyp,)."""
    label: IntArray
    """Assumed direction of arrival, (n_hyp,); for several targets (n_hyp, n_targets)."""
    kind: IntArray
    """Assumed kind of target, (n_hyp,); for several targets (n_hyp, n_targets)."""
    origin: IntArray
    """Index that each hypothesis had when the bank was created, (n_hyp,)."""
    nis: FloatArray
    """Normalised innovation squared of the latest frame, (n_hyp, n_sensors); NaN if missing."""

    @classmethod
    def from_targets(cls, x: FloatArray, P: FloatArray, label: IntArray, n_sensors: int,
                     background_std: float, own_covariance: FloatArray | None = None,
                     kind: IntArray | None = None) -> 'FilterBank':
        """Create a bank with equal weights from target states `x` (n_hyp, n_t).

        The own states of each sensor, with covariances `own_covariance` (n_sensors, n_own, n_own),
        then three backgrounds [T] per sensor, are appended; all are zero.
        """
        n, n_t = x.shape
        own = np.zeros((n_sensors, 0, 0)) if own_covariance is None else own_covariance
        n_own = own.shape[1]
        n_x = n_t + (n_own + 3) * n_sensors
        full_x, full_P = np.zeros((n, n_x)), np.zeros((n, n_x, n_x))
        full_x[:, :n_t], full_P[:, :n_t, :n_t] = x, P
        for j, block in enumerate(own):
            rows = slice(n_t + j * n_own, n_t + (j + 1) * n_own)
            full_P[:, rows, rows] = block
        backgrounds = np.arange(n_x - 3 * n_sensors, n_x)
        full_P[:, backgrounds, backgrounds] = background_std**2
        return cls(full_x, full_P, np.full(n, -np.log(n)), label,
                   np.zeros(n, dtype=int) if kind is None else kind, np.arange(n),
                   np.full((n, n_sensors), np.nan))

    def __len__(self) -> int:
        """Number of hypotheses."""
        return len(self.log_w)

    def best(self) -> int:
        """Index of the hypothesis to publish: of the heaviest label and, within it, of the heaviest
        kind, that of the maximum density of their mixture."""
        # The heaviest hypothesis would be a random choice if many neighbours share the weight.
        return core.best(self.x, self.P, self.log_w, _class_indices(self.label),
                         _class_indices(self.kind), _NEGLIGIBLE_LOG_RATIO)

    def extract_target(self, i: int, n_one: int) -> 'FilterBank':
        """Marginalise a joint bank to target `i` of `n_one` states, with the sensor states; the
        bank itself if it has a single target."""
        if self.label.ndim == 1:
            return self
        n_target_states = n_one * self.label.shape[1]
        columns = np.append(np.arange(i * n_one, (i + 1) * n_one),
                            np.arange(n_target_states, self.x.shape[1]))
        return FilterBank(*_selected_states(self.x, self.P, columns), self.log_w,
                          self.label[:, i].copy(), self.kind[:, i].copy(), self.origin, self.nis)

    def without_target(self, i: int, n_one: int) -> 'FilterBank':
        """Marginalise target `i` of `n_one` states out of a joint bank."""
        n_targets = self.label.shape[1]
        columns = np.delete(np.arange(self.x.shape[1]), np.arange(i * n_one, (i + 1) * n_one))
        label, kind = np.delete(self.label, i, axis=1), np.delete(self.kind, i, axis=1)
        if n_targets == 2:
            label, kind = label[:, 0].copy(), kind[:, 0].copy()
        return FilterBank(*_selected_states(self.x, self.P, columns), self.log_w.copy(), label,
                          kind, self.origin.copy(), self.nis.copy())

    def copy(self) -> 'FilterBank':
        """Return a deep copy."""
        return FilterBank(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    def rows(self, rows: IntArray) -> 'FilterBank':
        """Copy the hypotheses of the given indices, which may repeat, with equal weights."""
        selected = {f.name: np.ascontiguousarray(getattr(self, f.name)[rows]) for f in fields(self)}
        return FilterBank(**{**selected, 'log_w': np.full(len(rows), -np.log(len(rows)))})

    def alone(self, i: int) -> 'FilterBank':
        """Copy hypothesis `i` to a bank of its own."""
        return self.rows(np.array([i]))

    def weight(self, mask: BoolArray) -> float:
        """Total weight of the hypotheses selected by `mask` (n_hyp,)."""
        return float(np.exp(log_sum_exp(self.log_w[mask]))) if mask.any() else 0.0

    def is_concentrated_in(self, n: int, fraction: float) -> bool:
        """Whether the `n` heaviest hypotheses have at least a given fraction of the weight."""
        return bool(np.exp(np.sort(self.log_w)[-n:]).sum() >= fraction)

    def is_separated(self, i: int) -> BoolArray:
        """Flag the hypotheses (n_hyp,) whose position differs from hypothesis `i` by a Mahalanobis
        distance of more than three."""
        difference = self.x[:, :3] - self.x[i, :3]
        C = self.P[:, :3, :3] + self.P[i, :3, :3]
        try:
            # Nearly always positive definite; eigenvalues would take five times as long.
            z = np.square(np.linalg.solve(np.linalg.cholesky(C), difference[:, :, None])[:, :, 0]
                          ).sum(axis=1)
        except np.linalg.LinAlgError:
            variance, axes = np.linalg.eigh(C)
            along = np.einsum('ni,nij->nj', difference, axes)
            # Directions without variance do not count.
            varies = variance > _SINGULAR_TOLERANCE * variance[:, -1:]
            z = (along**2 / np.where(varies, variance, np.inf)).sum(axis=1)
        is_separated: BoolArray = z > 9.0
        return is_separated

    def reweight(self, log_likelihood: FloatArray) -> float:
        """Update the weights with the log-likelihoods of a frame; return the frame's log-evidence,
        -inf if no value is finite, which leaves the weights unchanged."""
        log_likelihood = np.where(np.isfinite(log_likelihood), log_likelihood, -np.inf)
        joint_log_w = self.log_w + log_likelihood
        evidence = log_sum_exp(joint_log_w)
        if np.isfinite(evidence):
            self.log_w = joint_log_w - evidence
        return evidence

    def keep(self, mask: BoolArray) -> int:
        """Keep the hypotheses of `mask` and normalise the weights; return the number removed."""
        rows = np.flatnonzero(mask)
        n_removed = len(mask) - len(rows)
        if n_removed:
            self.x, self.P = (_compacted(a, rows) for a in (self.x, self.P))
            self.log_w = self.log_w[mask] - log_sum_exp(self.log_w[mask])
            for name in ('label', 'kind', 'origin', 'nis'):
                setattr(self, name, getattr(self, name)[mask])
        return n_removed

    def prune(self, log_ratio: float, max_hypotheses: int) -> int:
        """Keep the heaviest hypotheses, at most `log_ratio` nats below the heaviest one and
        `max_hypotheses` in number; return the number removed."""
        mask = self.log_w >= self.log_w.max() - log_ratio
        if np.count_nonzero(mask) > max_hypotheses:
            order = np.argsort(-self.log_w, kind='stable')
            mask = np.zeros(len(self), dtype=bool)
            mask[order[:max_hypotheses]] = True
        return self.keep(mask)


def _selected_states(x: FloatArray, P: FloatArray, columns: IntArray
                     ) -> tuple[FloatArray, FloatArray]:
    """Copies of the selected states (n_hyp, n_x) and of their covariances."""
    return (np.ascontiguousarray(x[:, columns]),
            np.ascontiguousarray(P[:, columns[:, None], columns]))


def _class_indices(labels: IntArray) -> IntArray:
    """Class index (n,) of each hypothesis; hypotheses with equal `labels` have equal indices."""
    if labels.ndim == 1:
        return labels
    return np.unique(labels, axis=0, return_inverse=True)[1].reshape(-1)


def _compacted(a: FloatArray, rows: IntArray) -> FloatArray:
    """Select ascending `rows` (n,) by moving them to the beginning in place, which is faster than a
    copy; a copy is returned if they occupy less than half of the buffer."""
    buffer = a if a.base is None else a.base
    if len(rows) * a[:1].nbytes < buffer.nbytes // 2:
        return a[rows]
    for target, source in enumerate(rows.tolist()):
        if target != source:
            a[target] = a[source]
    return a[:len(rows)]


@dataclass
class InitialBank:
    """Compact copy of a `FilterBank` at its start, before target and sensor states are correlated.

    Smoothing and relinearisation restart at the beginning of a track. Storing the full covariances
    of all hypotheses would require as much memory as the bank.
    """

    x: FloatArray
    """States of the target, then of the sensors, (n_hyp, n_x)."""
    P: FloatArray
    """Covariances of the target states, (n_hyp, n_t, n_t)."""
    P_sensors: FloatArray
    """Covariance of the sensor states, common to all hypotheses, (n_x - n_t, n_x - n_t)."""
    label: IntArray
    kind: IntArray
    origin: IntArray
    n_sensors: int

    @classmethod
    def of(cls, bank: FilterBank, n_target: int) -> 'InitialBank':
        """Copy a bank before its first update, with `n_target` states of the target."""
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
