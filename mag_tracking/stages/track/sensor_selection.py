"""Selection of the sensors that a track uses in a large network, as the target moves.

A state has up to nine elements per sensor, and the cost of an update is cubic in the number of
sensors. Distant sensors would add little information and are not used.
"""

from dataclasses import replace

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track.observation import angle_priors
from mag_tracking.stages.track.settings import TrackSettings

PREDICTION_S = 0.5
"""[s] Prediction horizon of the position near which sensors are selected."""


def nearest_sensors(positions: FloatArray, position: FloatArray, n: int) -> IntArray:
    """Indices (n,) of the sensors nearest to a horizontal position (2,), in ascending order."""
    distance = np.hypot(*(positions[:, :2] - position).T)
    return np.sort(np.argsort(distance, kind='stable')[:n])


def offset_from_nearest(position: FloatArray, positions: FloatArray) -> FloatArray:
    """Horizontal vector (2,) from the nearest sensor to a position (2,), m."""
    offset: FloatArray = position - positions[nearest_sensors(positions, position, 1)[0], :2]
    return offset


def part_of_frame(frame: FieldFrame, rows: IntArray) -> FieldFrame:
    """Part of a frame with the readings of the sensors `rows`."""
    return replace(frame, field=frame.field[rows], covariance=frame.covariance[rows],
                   n_samples=frame.n_samples[rows], time_offset=frame.time_offset[rows])


class SensorSubset:
    """Sensors that a track uses: all sensors of a network, or a selection in a large network.

    Attributes
    ----------
    full_network : the network from which they are selected
    is_part : whether the sensors are a selection
    rows : (n,) int array, indices of the sensors in the full network, ascending
    network : network of the selected sensors
    """

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
        (n_x,).

        It is the same object if it already contains the nearer half of these sensors.
        """
        position = state[:2] + PREDICTION_S * state[3:5]
        is_enough = np.isin(
            nearest_sensors(self.full_network.positions, position, n // 2), self.rows).all()
        return self if is_enough else SensorSubset.near(self.full_network, position, n)

    def is_approached_by(self, track: Track) -> bool:
        """Whether a track moves towards its nearest sensor."""
        offset = offset_from_nearest(track.position[:2], self.network.positions)
        return bool(offset @ track.velocity[:2] < 0.0)

    def for_whole_network(self, track: Track, settings: TrackSettings) -> Track:
        """Extend a track record of these sensors to all sensors of the network."""
        return for_whole_network(track, self.rows, self.full_network, settings) if self.is_part \
            else track


def exchange_sensor_states(bank: FilterBank, before: IntArray, after: IntArray,
                           own_covariance: FloatArray, background_std: float) -> None:
    """Replace the sensor states of a bank, in place, by the states of other sensors, given by their
    indices in the network.

    The states and correlations of sensors in both sets are retained. `own_covariance`
    (n_after, n_own, n_own) is the initial covariance of the mounting angles and model errors of
    each new sensor, and `background_std` [T] the std of its background.
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


def for_whole_network(track: Track, rows: IntArray, network: SensorNetwork,
                      settings: TrackSettings) -> Track:
    """Extend a track record from the sensors `rows` to all sensors of the network.

    Entries of the other sensors are NaN; their mounting angles have the prior covariance.
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
