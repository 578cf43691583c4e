"""The bank of filters: hypotheses as arrays, their weights in logarithms.

Source: T10 section 2.6 and Alg. 3; weights live in logarithms because two
hypotheses may be thousands of nats apart.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference import core

_NEGLIGIBLE_LOG_RATIO = np.log(100.0)
"""Hypotheses lighter than the heaviest by more than this have no say in which is published."""
_SINGULAR_TOLERANCE = 1e-15
"""A variance that is less than this share of the largest is none, as in `numpy.linalg.pinv`."""


def log_sum_exp(a: ArrayLike, axis: int | None = None) -> FloatArray:
    """log(sum(exp(a))) without overflow; -inf where all are -inf."""
    a = np.asarray(a, dtype=float)
    top = np.max(a, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide='ignore'):
        total = np.log(np.sum(np.exp(a - top), axis=axis, keepdims=True)) + top
    out: FloatArray = total.squeeze() if axis is None else np.squeeze(total, axis=axis)
    return out


@dataclass
class FilterBank:
    """Hypotheses of one target, or of several that share a state; every array has the hypothesis as
    first axis."""

    x: FloatArray
    """(n_hyp, n_x) states."""
    P: FloatArray
    """(n_hyp, n_x, n_x) covariances."""
    log_w: FloatArray
    """(n_hyp,) normalised log-weights."""
    label: IntArray
    """(n_hyp,) int: the arrival that each hypothesis assumes; of several (n_hyp, n_targets)."""
    kind: IntArray
    """(n_hyp,) int: the kind of target that each assumes; of several (n_hyp, n_targets)."""
    origin: IntArray
    """(n_hyp,) int: the row that each hypothesis had when the bank was made."""
    nis: FloatArray
    """(n_hyp, n_sensors) normalised innovation squared of the latest measurement; NaN before it,
    and of a sensor that is missing."""

    @classmethod
    def from_targets(cls, x: FloatArray, P: FloatArray, label: IntArray, n_sensors: int,
                   background_std: float, own_covariance: FloatArray | None = None,
                   kind: IntArray | None = None) -> 'FilterBank':
        """A bank with equal weights from target states alone.

        `x` (n_hyp, n_t), `P` (n_hyp, n_t, n_t). Behind them are put each sensor's own
        states with the covariances `own_covariance` (n_sensors, n_own, n_own; none if left
        out), and three backgrounds a sensor with `background_std` [T]; all are zero. `kind`
        (n_hyp,) is 0 if left out.
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
        return len(self.log_w)

    def best(self) -> int:
        """Row of the hypothesis to publish.

        Of the heaviest label, and in it of the heaviest kind, the one at whose position
        their mixture is densest: near the mode of the posterior. The heaviest alone
        would be a lottery where many neighbours share the weight.
        """
        return core.best(self.x, self.P, self.log_w, _classes(self.label), _classes(self.kind),
                         _NEGLIGIBLE_LOG_RATIO)

    def extract_target(self, i: int, n_one: int) -> 'FilterBank':
        """The same hypotheses with the states of target `i` of several alone, each of which has
        `n_one` states; of a single target it is the bank itself.
        """
        if self.label.ndim == 1:
            return self
        others = n_one * self.label.shape[1]
        columns = np.append(np.arange(i * n_one, (i + 1) * n_one),
                            np.arange(others, self.x.shape[1]))
        return FilterBank(*_of_columns(self.x, self.P, columns), self.log_w,
                          self.label[:, i].copy(), self.kind[:, i].copy(), self.origin, self.nis)

    def without_target(self, i: int, n_one: int) -> 'FilterBank':
        """The same hypotheses of the other targets: what is known of them is marginal."""
        n_targets = self.label.shape[1]
        columns = np.delete(np.arange(self.x.shape[1]), np.arange(i * n_one, (i + 1) * n_one))
        label, kind = np.delete(self.label, i, axis=1), np.delete(self.kind, i, axis=1)
        if n_targets == 2:
            label, kind = label[:, 0].copy(), kind[:, 0].copy()
        return FilterBank(*_of_columns(self.x, self.P, columns), self.log_w.copy(), label, kind,
                          self.origin.copy(), self.nis.copy())

    def copy(self) -> 'FilterBank':
        """The same bank with arrays of its own."""
        return FilterBank(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    def rows(self, rows: IntArray) -> 'FilterBank':
        """A bank of the hypotheses `rows` (n,) int, weighted alike; its arrays are its own."""
        chosen = {f.name: np.ascontiguousarray(getattr(self, f.name)[rows]) for f in fields(self)}
        return FilterBank(**{**chosen, 'log_w': np.full(len(rows), -np.log(len(rows)))})

    def alone(self, i: int) -> 'FilterBank':
        """A bank of the hypothesis `i` alone; its arrays are its own."""
        return self.rows(np.array([i]))

    def weight(self, rows: BoolArray) -> float:
        """Total weight of the hypotheses of the mask `rows` (n_hyp,)."""
        return float(np.exp(log_sum_exp(self.log_w[rows]))) if rows.any() else 0.0

    def is_concentrated_in(self, n: int, share: float) -> bool:
        """Whether the `n` heaviest hypotheses have at least this share of the weight."""
        return bool(np.exp(np.sort(self.log_w)[-n:]).sum() >= share)

    def apart(self, i: int, distance: float = 3.0) -> BoolArray:
        """(n_hyp,) whether the position of a hypothesis is another one than that of row `i`.

        By more than `distance` deviations of the difference in some direction (both
        covariances), so neither explains the other.
        """
        difference = self.x[:, :3] - self.x[i, :3]
        C = self.P[:, :3, :3] + self.P[i, :3, :3]
        try:
            # Nearly always; the eigenvalues would take five times as long.
            z = np.square(np.linalg.solve(np.linalg.cholesky(C), difference[:, :, None])[:, :, 0]
                          ).sum(axis=1)
        except np.linalg.LinAlgError:
            variance, axes = np.linalg.eigh(C)
            along = np.einsum('ni,nij->nj', difference, axes)
            # Where nothing varies there is nothing to be apart by.
            varies = variance > _SINGULAR_TOLERANCE * variance[:, -1:]
            z = (along**2 / np.where(varies, variance, np.inf)).sum(axis=1)
        apart: BoolArray = z > distance**2
        return apart

    def reweight(self, log_likelihood: FloatArray) -> float:
        """Bayes' rule on the weights; returns the log-evidence of the frame.

        A hypothesis whose likelihood is not finite loses all its weight.
        If none is left the evidence is -inf and the weights stay as they were.
        """
        log_likelihood = np.where(np.isfinite(log_likelihood), log_likelihood, -np.inf)
        joint = self.log_w + log_likelihood
        evidence = float(log_sum_exp(joint))
        if np.isfinite(evidence):
            self.log_w = joint - evidence
        return evidence

    def keep(self, mask: BoolArray) -> int:
        """Keep the hypotheses of `mask` and normalise; returns how many went.

        The arrays `x` and `P` may be written into.
        """
        rows = np.flatnonzero(mask)
        gone = len(mask) - len(rows)
        if gone:
            self.x, self.P = (_compacted(a, rows) for a in (self.x, self.P))
            self.log_w = self.log_w[mask] - log_sum_exp(self.log_w[mask])
            for name in ('label', 'kind', 'origin', 'nis'):
                setattr(self, name, getattr(self, name)[mask])
        return gone

    def prune(self, log_ratio: float, most: int) -> int:
        """Drop what is below the best by more than `log_ratio`, and beyond the `most` best."""
        mask = self.log_w >= self.log_w.max() - log_ratio
        if np.count_nonzero(mask) > most:
            order = np.argsort(-self.log_w, kind='stable')
            mask = np.zeros(len(self), dtype=bool)
            mask[order[:most]] = True
        return self.keep(mask)


def _of_columns(x: FloatArray, P: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
    """Some of the states (n_hyp, n_x), and their covariances, as arrays of their own."""
    return (np.ascontiguousarray(x[:, columns]),
            np.ascontiguousarray(P[:, columns[:, None], columns]))


def _classes(labels: IntArray) -> IntArray:
    """(n,) int: one number for each set of labels (n,) or (n, n_targets)."""
    if labels.ndim == 1:
        return labels
    classes: IntArray = np.unique(labels, axis=0, return_inverse=True)[1].reshape(-1)
    return classes


def _compacted(a: FloatArray, rows: IntArray) -> FloatArray:
    """The `rows` (n,), ascending, of an array, at its beginning: what is new takes longer.

    A new array, though, where the rest would hold more memory than they do.
    """
    held = a if a.base is None else a.base
    if len(rows) * a[:1].nbytes < held.nbytes // 2:
        return a[rows]
    for new, old in enumerate(rows.tolist()):
        if new != old:
            a[new] = a[old]
    return a[:len(rows)]
