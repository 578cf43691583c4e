"""Sensors that contradict the others: found while a target is tracked, and left out of a frame.

A sensor whose axes were swapped, that was knocked over, or that another vehicle stands at, pulls
a track away from what all others say. Where a frame does not fit the leading hypothesis, and fits
it once one sensor, or a few, are taken for missing, it is they that are wrong.
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

ONE_IN = 8
"""No more than one sensor in so many can be wrong, but always one: else it is the track. Those that
are far from the target agree with everything."""


class SensorRejection:
    """Updates a bank with what of a frame can be believed."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self.clear()

    def clear(self) -> None:
        """No track is running."""
        self._left_out: tuple[int, ...] = ()

    def advance(self, bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame, dt: float
                ) -> 'tuple[FloatArray, FloatArray, FieldFrame, Counter[str]]':
        """Move the `FilterBank` through a frame, without sensors that contradict.

        Parameters
        ----------
        bank_filter : BankFilter
        bank : FilterBank
        frame : FieldFrame
        dt : float [s]

        Returns
        -------
        predicted : (n_hyp, n_x)
            The states before the update.
        log_likelihood : (n_hyp,)
        frame : FieldFrame
            What was used: sensors that were left out are missing.
        counts : Counter
            {what: number}, of the sensors that were left out.
        """
        # To keep all states takes as long as the update. Where the leader fits before it, one that
        # does not will hardly lead after it.
        may_contradict = not self._fits_leader(bank_filter, bank, frame, dt)
        before = bank.x, bank.P
        predicted, log_likelihood = bank_filter.advance(bank, frame, dt, keeps_prior=may_contradict)
        if not may_contradict or self._fits(bank_filter, bank, frame, log_likelihood):
            self._left_out = ()
            return predicted, log_likelihood, frame, Counter()
        whole = bank.x, bank.P, bank.nis, log_likelihood
        for left_out in self._suspicions(bank_filter, bank, before, frame, dt):
            log_likelihood, less = self._without(bank_filter, bank, before, frame, dt, left_out)
            if self._fits(bank_filter, bank, less, log_likelihood):
                self._left_out = left_out
                return predicted, log_likelihood, less, Counter(
                    {f'frames that {self._names[j]} contradicted': 1 for j in left_out})
        self._left_out = ()
        bank.x, bank.P, bank.nis, log_likelihood = whole
        return predicted, log_likelihood, frame, Counter()

    def _suspicions(self, bank_filter: BankFilter, bank: FilterBank, before: _States,
                    frame: FieldFrame, dt: float) -> Iterator[tuple[int, ...]]:
        """Sets of sensors, as tuples of rows, to be left out, one after the other."""
        present = np.flatnonzero(~np.isnan(frame.field).all(axis=1)).tolist()
        most = max(1, len(present) // ONE_IN) if len(present) > 1 else 0
        # Those of the frame before are the first that are suspected.
        again = tuple(j for j in self._left_out if j in present)
        if again and len(again) <= most:
            yield again
        found: tuple[int, ...] = ()
        while len(found) < most:
            # The one without which the others fit best is the next.
            misfit: dict[tuple[int, ...], float] = {}
            for j in present:
                if j not in found:
                    tried = (*found, j)
                    log_likelihood, less = self._without(
                        bank_filter, bank, before, frame, dt, tried)
                    misfit[tried] = _misfit(bank, less, log_likelihood)
            found = min(misfit, key=misfit.__getitem__)
            yield found

    @staticmethod
    def _without(bank_filter: BankFilter, bank: FilterBank, before: _States, frame: FieldFrame,
                 dt: float, left_out: tuple[int, ...]) -> tuple[FloatArray, FieldFrame]:
        """The frame once more, as if some sensors were missing: (log-likelihood, frame)."""
        missing = np.isin(np.arange(len(frame.field)), left_out)
        less = replace(frame, field=np.where(missing[:, None], np.nan, frame.field),
                       covariance=np.where(missing[:, None, None], np.nan, frame.covariance),
                       n_samples=np.where(missing, 0, frame.n_samples),
                       time_offset=np.where(missing, 0.0, frame.time_offset))
        bank.x, bank.P = before
        return bank_filter.advance(bank, less, dt, keeps_prior=True)[1], less

    @classmethod
    def _fits_leader(cls, bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame,
                     dt: float) -> bool:
        """Whether the frame will fit the hypothesis that leads before it."""
        leader = bank.alone(int(np.argmax(bank.log_w)))
        return cls._fits(bank_filter, leader, frame, bank_filter.advance(leader, frame, dt)[1])

    @staticmethod
    def _fits(bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame,
              log_likelihood: FloatArray) -> bool:
        """Whether the frame fits the hypothesis that leads after it."""
        leader = _leader(bank, log_likelihood)
        return leader is not None and not bank_filter.is_implausible(bank, leader, frame)


def _leader(bank: FilterBank, log_likelihood: FloatArray) -> int | None:
    """Row of the hypothesis that weighs most after the frame; None where none explains it."""
    log_w = bank.log_w + log_likelihood
    leader = int(np.argmax(log_w))
    return leader if np.isfinite(log_w[leader]) else None


def _misfit(bank: FilterBank, frame: FieldFrame, log_likelihood: FloatArray) -> float:
    """Normalised innovation squared per axis of the leading hypothesis."""
    leader = _leader(bank, log_likelihood)
    n_axes = np.count_nonzero(~np.isnan(frame.field))
    return np.inf if leader is None else float(np.nansum(bank.nis[leader])) / n_axes
