"""Sensors that a track uses in a large network, and rejection of those that contradict the others.

The cost of an update is cubic in the number of sensors, and distant ones add little information. A
sensor that was knocked over, or is near another vehicle, pulls a track away from all others. If a
frame fits the leading hypothesis only without a few sensors, these are rejected.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.observation import angle_priors
from mag_tracking.stages.track.settings import TrackSettings

PREDICTION_S = 0.5
"""[s] Prediction horizon of the position near which sensors are selected."""
_States: TypeAlias = tuple[FloatArray, FloatArray]
"""States and covariances of a bank."""
SENSORS_PER_REJECTION = 8
"""Number of measuring sensors for each sensor that may be rejected, at least one. If more must
be rejected, the track itself is wrong. A majority of fitting sensors does not confirm the track,
because sensors far from the target fit any hypothesis."""


def nearest_sensors(positions: FloatArray, position: FloatArray, n: int) -> IntArray:
    """Indices (n,) of the sensors nearest to a horizontal position (2,), in ascending order."""
    distance = np.hypot(*(positions[:, :2] - position).T)
    return np.sort(np.argsort(distance, kind='stable')[:n])


def offset_from_nearest(position: FloatArray, positions: FloatArray) -> FloatArray:
    """Horizontal vector (2,) from the nearest sensor to a position (2,), m."""
    return position - positions[nearest_sensors(positions, position, 1)[0], :2]


def part_of_frame(frame: FieldFrame, rows: IntArray) -> FieldFrame:
    """Part of a frame with the readings of the sensors `rows`."""
    return replace(frame, field=frame.field[rows], covariance=frame.covariance[rows],
                   n_samples=frame.n_samples[rows], time_offset=frame.time_offset[rows])


class SensorSubset:
    """Sensors that a track uses: all, or a selection of ascending `rows` of a large network."""

    def __init__(self, full_network: SensorNetwork, rows: IntArray | None = None) -> None:
        self.full_network = full_network
        self.is_part = rows is not None
        self.rows: IntArray = np.arange(len(full_network)) if rows is None else rows
        self.network = full_network if rows is None else full_network.part(rows)

    @classmethod
    def near(cls, full_network: SensorNetwork, position: FloatArray, n: int) -> 'SensorSubset':
        """Subset of the `n` sensors nearest to a horizontal position (2,)."""
        return cls(full_network, nearest_sensors(full_network.positions, position, n))

    def part_of(self, frame: FieldFrame) -> FieldFrame:
        """Readings of these sensors from a frame of the whole network."""
        return part_of_frame(frame, self.rows) if self.is_part else frame

    def ahead_of(self, state: FloatArray, n: int) -> 'SensorSubset':
        """Subset of the `n` sensors nearest to the predicted position of a target with `state`
        (n_x,); the same object if it already contains the nearer half of these sensors."""
        position = state[:2] + PREDICTION_S * state[3:5]
        is_enough = np.isin(
            nearest_sensors(self.full_network.positions, position, n // 2), self.rows).all()
        return self if is_enough else SensorSubset.near(self.full_network, position, n)

    def is_approached_by(self, track: Track) -> bool:
        """Whether a track moves towards its nearest sensor."""
        offset = offset_from_nearest(track.position[:2], self.network.positions)
        return bool(offset @ track.velocity[:2] < 0.0)

    def for_whole_network(self, track: Track, settings: TrackSettings) -> Track:
        """Extend a record to all sensors, with NaN and prior mounting angles."""
        if not self.is_part:
            return track
        n_sensors, rows = len(self.full_network), self.rows
        predicted, nis = np.full((n_sensors, 3), np.nan), np.full(n_sensors, np.nan)
        predicted[rows], nis[rows] = track.predicted, track.nis_by_sensor
        mounting, covariance = track.mounting, track.mounting_covariance
        if len(mounting):
            mounting = np.zeros((n_sensors, 3))
            covariance = angle_priors(self.full_network, np.deg2rad(settings.mounting_std_deg))
            mounting[rows], covariance[rows] = track.mounting, track.mounting_covariance
        return replace(track, predicted=predicted, nis_by_sensor=nis, mounting=mounting,
                       mounting_covariance=covariance)


def exchange_sensor_states(bank: FilterBank, before: IntArray, after: IntArray,
                           own_covariance: FloatArray, background_std: float) -> None:
    """Replace the sensor states of a bank, in place, by those of other sensors.

    States of sensors in both sets are retained; new ones have the initial `own_covariance`
    (n_after, n_own, n_own) of angles and model errors, and `background_std` [T].
    """
    n_own = own_covariance.shape[1]
    n_t = bank.x.shape[1] - (n_own + 3) * len(before)
    old, new = [_state_columns(n_t, n_own, len(rows)) for rows in (before, after)]
    common = [(list(before).index(row), k) for k, row in enumerate(after) if row in before]
    source = np.concatenate([np.arange(n_t), *(old[j] for j, _ in common)])
    destination = np.concatenate([np.arange(n_t), *(new[k] for _, k in common)])
    n_x = n_t + (n_own + 3) * len(after)
    x, P = np.zeros((len(bank), n_x)), np.zeros((len(bank), n_x, n_x))
    for k in set(range(len(after))) - {k for _, k in common}:
        own, background = new[k][:n_own], new[k][n_own:]
        P[:, own[:, None], own] = own_covariance[k]
        P[:, background, background] = background_std**2
    x[:, destination] = bank.x[:, source]
    P[:, destination[:, None], destination] = bank.P[:, source[:, None], source]
    bank.x, bank.P = x, P
    bank.nis = np.full((len(bank), len(after)), np.nan)


def _state_columns(n_t: int, n_own: int, n_sensors: int) -> IntArray:
    """Columns (n_sensors, n_own + 3) of each sensor's states in the joint state."""
    j = np.arange(n_sensors)[:, None]
    return np.hstack([n_t + n_own * j + np.arange(n_own),
                      n_t + n_own * n_sensors + 3 * j + np.arange(3)])


class SensorRejection:
    """Update of a bank that excludes sensors whose measurements contradict the other sensors."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self.clear()

    def clear(self) -> None:
        """Forget the sensors that were rejected in the previous frame."""
        self._rejected: tuple[int, ...] = ()

    def advance(self, bank_filter: BankFilter, bank: FilterBank, frame: FieldFrame, dt: float
                ) -> 'tuple[FloatArray, FloatArray, FieldFrame, Counter[str]]':
        """Predict and update a bank with a frame, without contradicting sensors; return predicted
        states (n_hyp, n_x), log-likelihoods (n_hyp,), the frame used, and rejections."""
        # Copying all states takes as long as the update. If the frame fits the hypothesis that
        # leads before the update, it usually also fits the hypothesis that leads afterwards.
        leader = bank.alone(int(np.argmax(bank.log_w)))
        may_contradict = not _fits(bank_filter, leader, frame,
                                   bank_filter.advance(leader, frame, dt)[1])
        prior = bank.x, bank.P
        predicted, log_likelihood = bank_filter.advance(bank, frame, dt, keeps_prior=may_contradict)
        if not may_contradict or _fits(bank_filter, bank, frame, log_likelihood):
            self._rejected = ()
            return predicted, log_likelihood, frame, Counter()
        full_update = bank.x, bank.P, bank.nis, log_likelihood
        for rejected in self._candidates(bank_filter, bank, prior, frame, dt):
            log_likelihood, reduced = _update_without(
                bank_filter, bank, prior, frame, dt, rejected)
            if _fits(bank_filter, bank, reduced, log_likelihood):
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
                    log_likelihood, reduced = _update_without(
                        bank_filter, bank, prior, frame, dt, candidate)
                    leader = _leader(bank, log_likelihood)
                    # Normalised innovation squared per axis of the leading hypothesis.
                    misfit[candidate] = np.inf if leader is None else float(
                        np.nansum(bank.nis[leader])) / np.count_nonzero(~np.isnan(reduced.field))
            rejected = min(misfit, key=misfit.__getitem__)
            yield rejected


def _update_without(bank_filter: BankFilter, bank: FilterBank, prior: _States, frame: FieldFrame,
                    dt: float, rejected: tuple[int, ...]) -> tuple[FloatArray, FieldFrame]:
    """Repeat the update without some sensors; return log-likelihoods and the reduced frame."""
    is_missing = np.isin(np.arange(len(frame.field)), rejected)
    reduced = replace(frame, field=np.where(is_missing[:, None], np.nan, frame.field),
                      covariance=np.where(is_missing[:, None, None], np.nan, frame.covariance),
                      n_samples=np.where(is_missing, 0, frame.n_samples),
                      time_offset=np.where(is_missing, 0.0, frame.time_offset))
    bank.x, bank.P = prior
    return bank_filter.advance(bank, reduced, dt, keeps_prior=True)[1], reduced


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
