"""Disturbances: smooth fields that start a track, but that no target explains.

Two models compete with a target: an independent field at each sensor (temperature, a knock, a
cable), and a field with a gradient (a geomagnetic storm, a power line, a tram). Both allow for the
model error of the tracker; otherwise they would be favoured whenever a target is near.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.event_records import Disturbance
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.filter_bank import log_sum_exp
from mag_tracking.inference.gauss_markov import GaussMarkovVectors
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame

FALSE_ALARM_PROBABILITY = 1e-6
"""Probability that the noise of a sensor alone marks it as affected in a frame."""
GRADIENT_RATIO = 0.3
"""Prior ratio of the change of a common field from centre to edge to the field."""
MIN_STD = 1e-15
"""[T] Minimum standard deviation of the noise of a sensor in a network file."""
UNKNOWN_FIELD_STD = 1e-4
"""Prior standard deviation of the field after a handover [T]."""
MIN_GRADIENT_SENSORS = 3
"""Minimum number of sensors that a gradient does not explain exactly."""
MAX_COMMON_SENSORS = 8
"""Maximum number of sensors in the model of a common field, whose cost grows with its cube."""
_Filters: TypeAlias = tuple[GaussMarkovVectors, GaussMarkovVectors, GaussMarkovVectors]
"""Independent fields of the covered and of the other sensors, and a common field of the covered."""


@dataclass(frozen=True)
class UnexplainedField:
    """Field of a track that no target explains."""

    track_id: int
    begin_ns: int
    largest: FloatArray
    """Largest field measured by each sensor, (n_sensors,) T."""
    sensed: BoolArray
    """Whether each sensor sensed the field, (n_sensors,)."""
    uniform: float
    """Probability of a common field over the network."""


class Disturbances:
    """Disturbance in progress, from the end of its first track to the release of the detection."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._next_id = 1
        self._current: Disturbance | None = None
        self._largest: FloatArray = np.zeros(len(names))
        self._sensed: BoolArray = np.zeros(len(names), dtype=bool)

    def begin(self, found: UnexplainedField, stamp_ns: int) -> list[Disturbance]:
        """Begin a disturbance and return its record, or extend the current one."""
        if self._current is not None:
            self._largest = np.maximum(self._largest, found.largest)
            self._sensed |= found.sensed
            self._current = replace(self._current, uniform=found.uniform, track_id=found.track_id)
            return []
        self._largest, self._sensed = found.largest.copy(), found.sensed.copy()
        self._current = Disturbance(stamp_ns, self._next_id, False, found.begin_ns,
                                    float(self._largest.max()), self._sensors(), found.uniform,
                                    found.track_id)
        self._next_id += 1
        return [self._current]

    def feed(self, frame: FieldFrame) -> None:
        """Update the current disturbance, if any, with a frame that belongs to no track."""
        if self._current is not None:
            energy, n_axes = whitened_energy(frame.field, frame.covariance)
            self._largest = np.maximum(self._largest, field_magnitudes(frame))
            self._sensed |= energy > chdtri(np.maximum(n_axes, 1), FALSE_ALARM_PROBABILITY)

    def end(self, stamp_ns: int) -> list[Disturbance]:
        """Return the closing record of the disturbance in progress, if any."""
        if self._current is None:
            return []
        last, self._current = self._current, None
        return [replace(last, stamp_ns=stamp_ns, ended=True, largest=float(self._largest.max()),
                        sensors=self._sensors())]

    def _sensors(self) -> tuple[str, ...]:
        """Names of the affected sensors, strongest field first."""
        order = np.argsort(-self._largest, kind='stable')
        return tuple(self._names[j] for j in order if self._sensed[j])


def field_magnitudes(frame: FieldFrame) -> FloatArray:
    """Magnitude (n_sensors,) of the field of a frame, T; 0 if the reading is missing."""
    magnitude: FloatArray = np.sqrt(np.nansum(np.square(frame.field), axis=1))
    return magnitude


class DisturbanceModel:
    """Models of smooth fields without a target, which start with a background of `background_std`
    [T] at the first frame of a track, but with an unknown field during the track (`is_handover`).
    """

    def __init__(self, network: SensorNetwork, background_std: float,
                 is_handover: bool = False) -> None:
        n = len(network)
        self._background_std, self._is_handover = background_std, is_handover
        self._sensor, self._own_H = np.repeat(np.arange(n), 3), np.tile(np.eye(3), (n, 1))
        # The common field covers the first sensors; the others have independent fields.
        covered = np.arange(min(n, MAX_COMMON_SENSORS))
        self._common_H = _common_field_matrix(
            network.part(covered) if n > len(covered) else network)
        self._filters: _Filters | None = None
        # Log-weights of independent fields and of a common field.
        self._log_w = np.log([0.5, 0.5])

    @property
    def uniform(self) -> float:
        """Probability of a common field over the network, given that there is no target."""
        return float(np.exp(self._log_w[1]))

    def log_density(self, frame: FieldFrame, dt: float, model_error: FloatArray) -> float | None:
        """Update the models with a frame and the variance `model_error` (n_sensors,) [T²] per axis;
        return its log-density, None for the first one after a handover, 0 before readings."""
        is_present = np.isfinite(frame.field.ravel())
        noise = np.einsum('jii->ji', frame.covariance)
        variance = np.maximum(noise + model_error[:, None], MIN_STD**2).ravel()[is_present]
        y = frame.field.ravel()[is_present]
        is_first = self._filters is None and self._is_handover
        if self._filters is None:
            if not len(y):
                return 0.0
            self._filters = self._initial_filters(float(np.median(noise.ravel()[is_present])))
        covered, remaining, common = self._filters
        sensor, H = self._sensor[is_present], self._own_H[is_present]
        k = int(np.searchsorted(sensor, MAX_COMMON_SENSORS))
        remaining_density = remaining.log_density(
            sensor[k:] - MAX_COMMON_SENSORS, H[k:], y[k:], variance[k:], dt)
        log_joint = self._log_w + remaining_density + [
            covered.log_density(sensor[:k], H[:k], y[:k], variance[:k], dt),
            common.log_density(np.zeros(k, dtype=np.int64),
                               self._common_H[is_present[:len(self._common_H)]], y[:k],
                               variance[:k], dt)]
        evidence = float(log_sum_exp(log_joint))
        self._log_w = log_joint - evidence
        return None if is_first else evidence

    def _initial_filters(self, noise: float) -> _Filters:
        """Filters of the fields at the first frame, whose median noise variance is `noise` [T²]."""
        scale = np.sqrt(self._background_std**2 + noise)
        n = len(self._sensor) // 3
        n_covered = min(n, MAX_COMMON_SENSORS)
        n_field = self._common_H.shape[1] - 3 * n_covered
        std = UNKNOWN_FIELD_STD if self._is_handover else self._background_std
        # The backgrounds follow the field in the state, and do not drift.
        scales = scale * np.concatenate([np.ones(3), np.full(n_field - 3, GRADIENT_RATIO),
                                         np.zeros(3 * n_covered)])
        scale_per_axis = np.full(3, scale)
        return (GaussMarkovVectors(n_covered, scale_per_axis, std),
                GaussMarkovVectors(n - n_covered, scale_per_axis, std),
                GaussMarkovVectors(1, scales, std))


def _common_field_matrix(network: SensorNetwork) -> FloatArray:
    """Matrix (3 n_sensors, m) that maps a common field and the backgrounds to the sensor axes; the
    gradient, symmetric and traceless, is in changes [T] from centre to edge."""
    n, R_sw = len(network), network.R_sw
    field = np.tile(np.eye(3), (n, 1, 1))
    if n >= MIN_GRADIENT_SENSORS:
        offsets = network.positions - network.centre
        radius = np.linalg.norm(offsets, axis=1).max()
        x, y, z = (offsets / (radius or 1.0)).T
        zero = np.zeros(n)
        # Columns: Gxx, Gyy, Gxy, Gxz, Gyz; Gzz = -Gxx - Gyy.
        gradient = np.stack([np.stack([x, zero, y, z, zero], axis=1),
                             np.stack([zero, y, x, zero, z], axis=1),
                             np.stack([-z, -z, zero, x, y], axis=1)], axis=1)
        field = np.concatenate([field, gradient], axis=2)
    return np.hstack([(R_sw @ field).reshape(3 * n, -1), np.eye(3 * n)])
