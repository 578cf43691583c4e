"""Measurement model of a bank: the fields at the sensors as a function of the filter states."""

from collections.abc import Iterable

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import rotated_fields, sensor_fields
from mag_tracking.physics.sources import SourceModel

MAX_ROTATION = np.deg2rad(15.0)
"""[rad] Maximum standard deviation of a mounting angle. Larger values are reduced to this maximum,
because rotations are approximated to first order. `TrackManager` counts the affected sensors."""
TIME_RESOLUTION_S = 1e-3
"""[s] Resolution of sampling times. At 20 m/s, a target moves two centimetres in this time."""


def angle_priors(network: SensorNetwork, mounting_std: float) -> FloatArray:
    """Covariances (n_sensors, 3, 3) of the mounting rotations about the axes of the sensor at the
    start of a track, rad²; `mounting_std` [rad] applies to sensors without `orientation_std`."""
    std = [np.full(3, mounting_std) if s is None else np.minimum(s, MAX_ROTATION)
           for s in network.orientation_std]
    # The angles are about the axes of the sensor, but `orientation_std` is about the world axes.
    priors: FloatArray = np.einsum('jik,jk,jlk->jil', network.R_sw, np.square(std), network.R_sw)
    # Exact symmetry is preserved by all later operations.
    return 0.5 * (priors + np.swapaxes(priors, 1, 2))


class Observation:
    """Predicted fields of a network for hypotheses, and the layout of the sensor states.

    The state begins with those of `n_targets` targets, whose fields add up. The states of each
    sensor follow: three mounting angles [rad] unless `mounting_std` [rad], for sensors without
    `orientation_std`, is 0, and three model errors in units of their std unless `error_time` is 0.
    The backgrounds of all sensors [T] come last, as described in `inference/hypothesis.hpp`.

    The model errors represent the field that the target model neglects near a vehicle, as
    Gauss-Markov processes with the correlation time `error_time` [s], so that their weight does not
    depend on the frame period; if it is 0, they are noise in every frame.

    `n_angles`, `n_one` and `n_target` count angles per sensor, states per target, and of all
    targets; `own_covariance` (n_sensors, n_own, n_own) is that of the sensor states at the start of
    a track.
    """

    def __init__(self, network: SensorNetwork, model: SourceModel, mounting_std: float,
                 error_time: float, n_targets: int = 1) -> None:
        self.positions: FloatArray = np.ascontiguousarray(network.positions, dtype=float)
        self.R_sw: FloatArray = np.ascontiguousarray(network.R_sw, dtype=float)
        self._model = model
        self._error_time = error_time
        self.n_angles = 3 if mounting_std else 0
        self.n_targets = n_targets
        self.n_one = len(model.state_names)
        self.n_target = n_targets * self.n_one
        n_own = self.n_angles + (3 if error_time else 0)
        self.own_covariance = np.zeros((len(network), n_own, n_own))
        errors = np.arange(self.n_angles, n_own)
        self.own_covariance[:, errors, errors] = 1.0
        if mounting_std:
            self.own_covariance[:, :3, :3] = angle_priors(network, mounting_std)
        self.single_target: Observation = self if n_targets == 1 else Observation(
            network, model, mounting_std, error_time)
        # Masks for the states of the sensors: 1 for model errors or backgrounds, else 0.
        is_error = np.tile(np.arange(n_own) >= self.n_angles, len(network))
        self._is_error: FloatArray = np.append(is_error, np.zeros(3 * len(network)))
        self._is_background: FloatArray = np.append(0.0 * is_error, np.ones(3 * len(network)))

    @property
    def n_own(self) -> int:
        """Number of mounting angles and model errors per sensor."""
        return self.own_covariance.shape[1]

    def n_states(self, n_sensors: int) -> int:
        """Number of states of the targets and of `n_sensors` sensors."""
        return self.n_target + (self.n_own + 3) * n_sensors

    def own(self, x: FloatArray) -> FloatArray:
        """Mounting angles and model errors (..., n_sensors, n_own) of states (..., n_x), a view."""
        n = len(self.positions)
        own = x[..., self.n_target:x.shape[-1] - 3 * n]
        return own.reshape(*own.shape[:-1], n, self.n_own)

    def angles(self, x: FloatArray) -> FloatArray:
        """Mounting angles (..., n_sensors, 3) of states (..., n_x), rad; none if not estimated."""
        return self.own(x)[..., :3] if self.n_angles else np.zeros((*x.shape[:-1], 0, 3))

    def angle_covariances(self, P: FloatArray) -> FloatArray:
        """Covariances (n_sensors, 3, 3) of the mounting angles, rad²; none if not estimated."""
        first = self.n_target + self.n_own * np.arange(len(self.positions))
        rows = first[:, None] + np.arange(3)
        return P[rows[:, :, None], rows[:, None, :]] if self.n_angles else np.zeros((0, 3, 3))

    def distance_to_nearest(self, x: FloatArray) -> FloatArray:
        """Smallest distance (n_hyp,) between a target and a sensor, m."""
        targets = x[:, :self.n_target].reshape(len(x), self.n_targets, self.n_one)[:, :, None, :3]
        nearest: FloatArray = np.linalg.norm(targets - self.positions, axis=3).min(axis=(1, 2))
        return nearest

    def drift(self, dt: FloatArray, background_density: float) -> tuple[FloatArray, FloatArray]:
        """Decay factor and added variance of the sensor states over intervals `dt` (...) [s], both
        (..., (n_own + 3) n_sensors), with a random walk of `background_density` [T/s^0.5]."""
        decay = np.exp(-np.abs(dt) / self._error_time) if self._error_time else np.ones(dt.shape)
        variance: FloatArray = np.multiply.outer(1.0 - decay**2, self._is_error) \
            + np.multiply.outer(background_density**2 * np.maximum(dt, 0.0), self._is_background)
        return 1.0 - np.multiply.outer(1.0 - decay, self._is_error), variance

    def target_fields(self, x: FloatArray, time_offset: FloatArray, near_field_length: FloatArray
                      ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Target fields (n_hyp, n_sensors, 3) [T] in the sensor frame at the sampling time of each
        sensor, without mounting and model errors, their derivatives
        (n_hyp, n_sensors, 3, n_target), and the variance (n_hyp, n_sensors) [T²] of the model error
        near the targets, of the field gradient times `near_field_length` (n_hyp, n_targets) [m]."""
        h, H, gradients = zip(*(
            self._single_target_field(x[:, first:first + self.n_one], time_offset)
            for first in range(0, self.n_target, self.n_one)), strict=True)
        # NaN if a dipole is at a sensor, like the field there, even if the length is zero.
        with np.errstate(invalid='ignore'):
            variance = sum(np.square(length)[:, None] * gradient**2 for length, gradient in zip(
                near_field_length.T, gradients, strict=True))
        return sum(h[1:], h[0]), np.concatenate(H, axis=3), np.asarray(variance)

    def _single_target_field(self, x: FloatArray, time_offset: FloatArray
                             ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Field of one target with states (n_hyp, n_one), as returned by `sensor_fields`."""
        n_hyp, n, n_t = len(x), len(self.positions), self.n_one
        if not time_offset.any():
            return sensor_fields(self.positions, self.R_sw, *self._model.dipoles(x))
        h, H = np.empty((n_hyp, n, 3)), np.empty((n_hyp, n, 3, n_t))
        gradient = np.empty((n_hyp, n))
        steps = np.round(time_offset / TIME_RESOLUTION_S)
        for step in np.unique(steps):
            j = np.flatnonzero(steps == step)
            moved, F = self._model.propagate(x, step * TIME_RESOLUTION_S)
            h[:, j], H_moved, gradient[:, j] = sensor_fields(
                self.positions[j], self.R_sw[j], *self._model.dipoles(moved))
            H[:, j] = H_moved @ (F if F.ndim == 2 else F[:, None])
        return h, H, gradient

    def field_of(self, x: FloatArray, targets: Iterable[int], time_offset: FloatArray
                 ) -> FloatArray:
        """Field (n_sensors, 3) [T] of selected targets of a state `x` (n_x,)."""
        n = self.n_one
        h, H = np.zeros((1, *self.positions.shape)), np.zeros((1, *self.positions.shape, 0))
        for target in targets:
            h = h + self._single_target_field(x[None, target * n:(target + 1) * n], time_offset)[0]
        if self.n_angles:
            h, _ = rotated_fields(h, H, np.ascontiguousarray(self.own(x[None])[..., :3]))
        field: FloatArray = h[0]
        return field

    def fields(self, x: FloatArray, time_offset: FloatArray, near_field_length: FloatArray,
               field_error: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fields h (n_hyp, n_sensors, 3) [T] in the sensor frame, without the backgrounds, their
        derivatives H (n_hyp, n_sensors, 3, n_target + n_own), and the variance (n_hyp, n_sensors)
        of the model error [T²], 0 if the model errors are states.

        The error is relative to the field (`field_error`) and its gradient (`near_field_length`,
        (n_hyp, n_targets) [m]), as noise in [ICASSP11]_ eq. (9). H neglects that its std depends on
        the state.
        """
        h, H, variance = self.target_fields(x, time_offset, near_field_length)
        variance = variance + _proportional_variance(h, field_error)
        own = self.own(x)
        if self.n_angles:
            h, H = rotated_fields(h, H, np.ascontiguousarray(own[..., :3]))
        if not self._error_time:
            return h, H, variance
        std = np.sqrt(variance)[:, :, None]
        h = h + std * own[..., -3:]
        H = np.concatenate([H, std[..., None] * np.eye(3)], axis=3)
        return h, H, np.zeros_like(variance)

    def model_error(self, x: FloatArray, near_field_length: FloatArray, field_error: float
                    ) -> FloatArray:
        """Variance (n_sensors,) of the model error on each axis for one state `x` (n_x,), T², with
        parameters as for `fields`; NaN if a dipole is at a sensor."""
        h, _, variance = self.target_fields(x[None], np.zeros(len(self.positions)),
                                            near_field_length[None])
        return np.asarray(variance[0] + _proportional_variance(h, field_error)[0])


def _proportional_variance(h: FloatArray, field_error: float) -> FloatArray:
    """Variance (n_hyp, n_sensors) [T^2] of a model error that is proportional to the field."""
    variance: FloatArray = field_error**2 * np.einsum('pji,pji->pj', h, h)
    return variance
