"""Rejection of sensors that contradict the others, frame by frame.

A faulty sensor pulls a track away from the measurements of all other sensors. Its axes may be
swapped, it may have been knocked over, or it may be near another vehicle. If a frame fits the
leading hypothesis only without one or a few sensors, these sensors are rejected.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter

_States: TypeAlias = tuple[FloatArray, FloatArray]
"""States and covariances of a bank."""

SENSORS_PER_REJECTION = 8
"""Number of measuring sensors for each sensor that may be rejected. With fewer sensors, one may be
rejected. If more rejections are needed, the track itself is wrong. A majority of fitting sensors
does not confirm the track, because sensors far from the target fit any hypothesis."""


class SensorRejection:
    """Update of a bank that excludes sensors whose measurements contradict the other sensors."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self.clear()

    def clear(self) -> None:
        """Clear the list of sensors that were rejected in the previous frame."""
        self._rejected: tuple[int, ...] = ()

    def advance(self, bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame, dt: float
                ) -> 'tuple[FloatArray, FloatArray, FieldFrame, Counter[str]]':
        """Predict and update a bank with a frame, without sensors that contradict the others.

        Returns the predicted states (n_hyp, n_x), log-likelihoods (n_hyp,), the frame without the
        rejected sensors, and the number of rejections by description, one per rejected sensor.
        """
        # Copying all states takes as long as the update. If the frame fits the hypothesis that
        # leads before the update, it usually also fits the hypothesis that leads afterwards.
        may_contradict = not self._fits_leader(bank_filter, bank, frame, dt)
        prior = bank.x, bank.P
        predicted, log_likelihood = bank_filter.advance(bank, frame, dt, keeps_prior=may_contradict)
        if not may_contradict or self._fits(bank_filter, bank, frame, log_likelihood):
            self._rejected = ()
            return predicted, log_likelihood, frame, Counter()
        full_update = bank.x, bank.P, bank.nis, log_likelihood
        for rejected in self._candidates(bank_filter, bank, prior, frame, dt):
            log_likelihood, reduced = self._update_without(
                bank_filter, bank, prior, frame, dt, rejected)
            if self._fits(bank_filter, bank, reduced, log_likelihood):
                self._rejected = rejected
                return predicted, log_likelihood, reduced, Counter(
                    {f'frames in which {self._names[j]} was rejected': 1 for j in rejected})
        self._rejected = ()
        bank.x, bank.P, bank.nis, log_likelihood = full_update
        return predicted, log_likelihood, frame, Counter()

    def _candidates(self, bank_filter: BankFilter, bank: FilterBank, prior: _States,
                    frame: FieldFrame, dt: float) -> Iterator[tuple[int, ...]]:
        """Sets of sensor indices to be rejected, the most suspect first."""
        present = np.flatnonzero(~np.isnan(frame.field).all(axis=1)).tolist()
        max_rejected = max(1, len(present) // SENSORS_PER_REJECTION) if len(present) > 1 else 0
        # The sensors rejected in the previous frame are tried first.
        previous = tuple(j for j in self._rejected if j in present)
        if previous and len(previous) <= max_rejected:
            yield previous
        rejected: tuple[int, ...] = ()
        while len(rejected) < max_rejected:
            # The next candidate is the sensor without which the other sensors fit best.
            misfit: dict[tuple[int, ...], float] = {}
            for j in present:
                if j not in rejected:
                    candidate = (*rejected, j)
                    log_likelihood, reduced = self._update_without(
                        bank_filter, bank, prior, frame, dt, candidate)
                    misfit[candidate] = _misfit(bank, reduced, log_likelihood)
            rejected = min(misfit, key=misfit.__getitem__)
            yield rejected

    @staticmethod
    def _update_without(bank_filter: BankFilter, bank: FilterBank, prior: _States,
                        frame: FieldFrame, dt: float, rejected: tuple[int, ...]
                        ) -> tuple[FloatArray, FieldFrame]:
        """Repeat the update without some sensors; return log-likelihoods and the reduced frame."""
        is_missing = np.isin(np.arange(len(frame.field)), rejected)
        reduced = replace(frame, field=np.where(is_missing[:, None], np.nan, frame.field),
                          covariance=np.where(is_missing[:, None, None], np.nan, frame.covariance),
                          n_samples=np.where(is_missing, 0, frame.n_samples),
                          time_offset=np.where(is_missing, 0.0, frame.time_offset))
        bank.x, bank.P = prior
        return bank_filter.advance(bank, reduced, dt, keeps_prior=True)[1], reduced

    @classmethod
    def _fits_leader(cls, bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame,
                     dt: float) -> bool:
        """Whether the frame fits the hypothesis that leads before the update."""
        leader = bank.alone(int(np.argmax(bank.log_w)))
        return cls._fits(bank_filter, leader, frame, bank_filter.advance(leader, frame, dt)[1])

    @staticmethod
    def _fits(bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame,
              log_likelihood: FloatArray) -> bool:
        """Whether the frame fits the hypothesis that leads after the update."""
        leader = _leader(bank, log_likelihood)
        return leader is not None and not bank_filter.is_implausible(bank, leader, frame)


def _leader(bank: FilterBank, log_likelihood: FloatArray) -> int | None:
    """Index of the heaviest hypothesis after a frame; None if no hypothesis explains it."""
    log_w = bank.log_w + log_likelihood
    leader = int(np.argmax(log_w))
    return leader if np.isfinite(log_w[leader]) else None


def _misfit(bank: FilterBank, frame: FieldFrame, log_likelihood: FloatArray) -> float:
    """Normalised innovation squared per axis of the leading hypothesis; infinite if none leads."""
    leader = _leader(bank, log_likelihood)
    n_axes = np.count_nonzero(~np.isnan(frame.field))
    return np.inf if leader is None else float(np.nansum(bank.nis[leader])) / n_axes
