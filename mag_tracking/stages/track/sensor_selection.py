"""Neighbourhood: of a large network the sensors that a track needs, which change as it moves on.

A state has up to nine numbers of each sensor, and an update takes time with the cube of
the sensors. Far ones see nothing of the target; what they could still tell of it is given away.
"""

from dataclasses import replace

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track.observation import angle_priors
from mag_tracking.stages.track.settings import TrackSettings

AHEAD_S = 0.5
"""[s] The sensors are chosen for where the target will be then."""


def nearest(positions: FloatArray, place: FloatArray, n: int) -> IntArray:
    """Rows (n,), ascending, of the sensors at `positions` (n_sensors, 3) nearest to a `place`."""
    distance = np.hypot(*(positions[:, :2] - place).T)
    return np.sort(np.argsort(distance, kind='stable')[:n])


def from_nearest(place: FloatArray, positions: FloatArray) -> FloatArray:
    """(2,) [m] to a `place` (2,) from the nearest sensor of `positions` (n_sensors, 3)."""
    away: FloatArray = place - positions[nearest(positions, place, 1)[0], :2]
    return away


def part_of_frame(frame: FieldFrame, rows: IntArray) -> FieldFrame:
    """The `FieldFrame` of some sensors alone."""
    return replace(frame, field=frame.field[rows], covariance=frame.covariance[rows],
                   n_samples=frame.n_samples[rows], time_offset=frame.time_offset[rows])


class SensorSubset:
    """The sensors that a track uses: all of a network, or some rows of a large one."""

    def __init__(self, whole: SensorNetwork, rows: IntArray | None = None) -> None:
        """`rows` ascending; None = all."""
        self.whole = whole
        self.is_part = rows is not None
        self.rows: IntArray = np.arange(len(whole)) if rows is None else rows
        self.network = whole if rows is None else whole.part(rows)

    @classmethod
    def near(cls, whole: SensorNetwork, place: FloatArray, n: int) -> 'SensorSubset':
        """The `n` sensors nearest to a `place` (2,) [m]."""
        return cls(whole, nearest(whole.positions, place, n))

    def part_of(self, frame: FieldFrame) -> FieldFrame:
        """What of a frame of the whole network these sensors measured."""
        return part_of_frame(frame, self.rows) if self.is_part else frame

    def ahead_of(self, state: FloatArray, n: int) -> 'SensorSubset':
        """The `n` sensors nearest to where a target of this state (n_x,) will be soon; these, if
        the nearer half of them is among these."""
        place = state[:2] + AHEAD_S * state[3:5]
        serve = np.isin(nearest(self.whole.positions, place, n // 2), self.rows).all()
        return self if serve else SensorSubset.near(self.whole, place, n)

    def is_neared_by(self, track: Track) -> bool:
        """Whether a `Track` moves towards the sensor that it is nearest to."""
        away = from_nearest(track.position[:2], self.network.positions)
        return bool(away @ track.velocity[:2] < 0.0)

    def widened(self, track: Track, settings: TrackSettings) -> Track:
        """A `Track` of these sensors as one of the whole network."""
        return widened(track, self.rows, self.whole, settings) if self.is_part else track


def hand_on(bank: FilterBank, before: IntArray, after: IntArray, own_covariance: FloatArray,
            background_std: float) -> None:
    """Give the hypotheses of a `FilterBank`, in place, the states of other sensors.

    Parameters
    ----------
    bank : FilterBank
    before, after : (n_before,), (n_after,) int
        Rows in the network of the sensors whose states they have and shall have; those of both
        keep what is known of them, and how it hangs together.
    own_covariance : (n_after, n_own, n_own)
        Of a new sensor's own states, which come between the target's and the backgrounds.
    background_std : float [T]
        Of a new sensor's background.
    """
    n_own = own_covariance.shape[1]
    n_t = bank.x.shape[1] - (n_own + 3) * len(before)
    old, new = [_places(n_t, n_own, len(rows)) for rows in (before, after)]
    kept = [(list(before).index(row), k) for k, row in enumerate(after) if row in before]
    source = np.concatenate([np.arange(n_t), *(old[j] for j, _ in kept)])
    target = np.concatenate([np.arange(n_t), *(new[k] for _, k in kept)])
    n_x = n_t + (n_own + 3) * len(after)
    x, P = np.zeros((len(bank), n_x)), np.zeros((len(bank), n_x, n_x))
    for k in set(range(len(after))) - {k for _, k in kept}:
        own, background = new[k][:n_own], new[k][n_own:]
        P[:, own[:, None], own] = own_covariance[k]
        P[:, background, background] = background_std**2
    x[:, target] = bank.x[:, source]
    P[:, target[:, None], target] = bank.P[:, source[:, None], source]
    bank.x, bank.P = x, P
    bank.nis = np.full((len(bank), len(after)), np.nan)


def _places(n_t: int, n_own: int, n_sensors: int) -> IntArray:
    """Of each sensor the places of its states: (n_sensors, n_own + 3)."""
    j = np.arange(n_sensors)[:, None]
    return np.hstack([n_t + n_own * j + np.arange(n_own),
                      n_t + n_own * n_sensors + 3 * j + np.arange(3)])


def widened(track: Track, rows: IntArray, network: SensorNetwork, settings: TrackSettings) -> Track:
    """A `Track` of the sensors `rows` as one of the whole `network`.

    What it says nothing of is NaN, and a mounting is what was known of it before.
    """
    n_sensors = len(network)
    predicted, nis = np.full((n_sensors, 3), np.nan), np.full(n_sensors, np.nan)
    predicted[rows], nis[rows] = track.predicted, track.nis_by_sensor
    mounting, covariance = track.mounting, track.mounting_covariance
    if len(mounting):
        mounting = np.zeros((n_sensors, 3))
        covariance = angle_priors(network, np.deg2rad(settings.mounting_std_deg))
        mounting[rows], covariance[rows] = track.mounting, track.mounting_covariance
    return replace(track, predicted=predicted, nis_by_sensor=nis, mounting=mounting,
                   mounting_covariance=covariance)
