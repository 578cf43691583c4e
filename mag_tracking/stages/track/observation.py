"""What the sensors see of a bank's states: where the target's physics meets the filter's states."""

from collections.abc import Iterable

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.physics.mounting import rotated_fields
from mag_tracking.physics.sources import SourceModel

MAX_ROTATION = np.deg2rad(15.0)
"""[rad] A sensor whose orientation is less certain is tracked as if it were as certain as this: the
angles are of first order. `TrackManager` counts such sensors."""

SAME_TIME_S = 1e-3
"""[s] Samples closer than this are taken together: at 20 m/s a target moves two centimetres."""


def angle_priors(network: SensorNetwork, mounting_std: float) -> FloatArray:
    """(n_sensors, 3, 3) [rad^2] of the mounting angles when a track begins.

    `mounting_std` [rad] is that of a sensor whose `orientation_std` is not known.
    """
    std = [np.full(3, mounting_std) if s is None else np.minimum(s, MAX_ROTATION)
           for s in network.orientation_std]
    # The angles are about the sensor's axes, what is known of them about the world's.
    priors: FloatArray = np.einsum('jik,jk,jlk->jil', network.R_sw, np.square(std), network.R_sw)
    # Exactly symmetric, and so stays all that comes of it.
    return 0.5 * (priors + np.swapaxes(priors, 1, 2))


class Observation:
    """The field that a network has of hypotheses, and the states that belong to its sensors.

    A state is as on top of `inference/hypothesis.hpp`: the states of `n_targets` targets of one
    model, whose fields add up, one after the other. Behind the targets' states come each sensor's
    own: three mounting angles [rad] where they are estimated, and three model errors, in
    units of their size, where those last. They are what the target model leaves out near a
    vehicle, and stay alike for `error_time` (first-order Gauss-Markov), so that what is counted
    of them does not depend on the frame period. Without an `error_time` they are new every frame.
    """

    def __init__(self, network: SensorNetwork, model: SourceModel, mounting_std: float,
                 error_time: float, n_targets: int = 1) -> None:
        """`mounting_std` [rad] is that of a sensor whose `orientation_std` is not known."""
        self.positions: FloatArray = np.ascontiguousarray(network.positions, dtype=float)
        """(n_sensors, 3) [m]"""
        self.R_sw: FloatArray = np.ascontiguousarray(network.R_sw, dtype=float)
        """(n_sensors, 3, 3) world to sensor."""
        self._model = model
        self._error_time = error_time
        self.n_angles = 3 if mounting_std else 0
        """States of each sensor for how it is mounted."""
        self.n_targets = n_targets
        self.n_one = len(model.state_names)
        """States of each target."""
        self.n_target = n_targets * self.n_one
        n_own = self.n_angles + (3 if error_time else 0)
        self.own_covariance = np.zeros((len(network), n_own, n_own))
        """(n_sensors, n_own, n_own) of the sensors' own states when a track begins."""
        errors = np.arange(self.n_angles, n_own)
        self.own_covariance[:, errors, errors] = 1.0
        if mounting_std:
            self.own_covariance[:, :3, :3] = angle_priors(network, mounting_std)
        self.of_one: Observation = self if n_targets == 1 else Observation(
            network, model, mounting_std, error_time)
        """The same of a single target."""
        # Of the states behind the target's: 1 where it is one of these, else 0.
        is_error = np.tile(np.arange(n_own) >= self.n_angles, len(network))
        self._is_error: FloatArray = np.append(is_error, np.zeros(3 * len(network)))
        self._is_background: FloatArray = np.append(0.0 * is_error, np.ones(3 * len(network)))

    @property
    def n_own(self) -> int:
        """States of each sensor between the target's and the backgrounds."""
        return self.own_covariance.shape[1]

    def n_states(self, n_sensors: int) -> int:
        """States of a target that is seen by so many sensors."""
        return self.n_target + (self.n_own + 3) * n_sensors

    def own(self, x: FloatArray) -> FloatArray:
        """(..., n_sensors, n_own): the sensors' own states among those on the last axis of `x`."""
        n = len(self.positions)
        own = x[..., self.n_target:x.shape[-1] - 3 * n]
        return own.reshape(*own.shape[:-1], n, self.n_own)

    def angles(self, x: FloatArray) -> FloatArray:
        """(..., n_sensors, 3) [rad] mounting angles; (..., 0, 3) where they are not estimated."""
        return self.own(x)[..., :3] if self.n_angles else np.zeros((*x.shape[:-1], 0, 3))

    def angle_covariances(self, P: FloatArray) -> FloatArray:
        """(n_sensors, 3, 3) [rad^2] of the mounting angles, among `P` (n_x, n_x); or (0, 3, 3)."""
        first = self.n_target + self.n_own * np.arange(len(self.positions))
        rows = first[:, None] + np.arange(3)
        return P[rows[:, :, None], rows[:, None, :]] if self.n_angles else np.zeros((0, 3, 3))

    def without_errors(self, x: FloatArray) -> FloatArray:
        """The states `x` (n_hyp, n_x), copied, with model errors of zero."""
        x = x.copy()
        self.own(x)[..., self.n_angles:] = 0.0
        return x

    def nearest(self, x: FloatArray) -> FloatArray:
        """(n_hyp,) [m] from the positions of the states `x` (n_hyp, n_x) to the nearest sensor."""
        away = np.linalg.norm(self.places(x)[:, :, None] - self.positions, axis=3)
        nearest: FloatArray = away.min(axis=(1, 2))
        return nearest

    def places(self, x: FloatArray) -> FloatArray:
        """(n_hyp, n_targets, 3) [m] positions of the targets of the states `x` (n_hyp, n_x)."""
        places: FloatArray = x[:, :self.n_target].reshape(
            len(x), self.n_targets, self.n_one)[:, :, :3]
        return places

    def drift(self, dt: FloatArray, background_density: float) -> tuple[FloatArray, FloatArray]:
        """What becomes of the sensors' states over the times `dt` (...) [s].

        Returns
        -------
        decay, variance : (..., (n_own + 3) n_sensors)
            They are multiplied by the one, and the other is added.
        """
        fading = np.exp(-np.abs(dt) / self._error_time) if self._error_time else np.ones(dt.shape)
        variance: FloatArray = np.multiply.outer(1.0 - fading**2, self._is_error) \
            + np.multiply.outer(background_density**2 * np.maximum(dt, 0.0), self._is_background)
        return 1.0 - np.multiply.outer(1.0 - fading, self._is_error), variance

    def target_fields(self, x: FloatArray, time_offset: FloatArray, near_field_length: FloatArray
                      ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Field of the targets alone, at each sensor's own time.

        Parameters
        ----------
        x : (n_hyp, n_x)
        time_offset : (n_sensors,) [s]
        near_field_length : (n_hyp, n_targets) [m]

        Returns
        -------
        h : (n_hyp, n_sensors, 3) [T], sensor frame
        H : (n_hyp, n_sensors, 3, n_target)
        variance : (n_hyp, n_sensors) [T^2]
            Of what the models leave out near the targets; they do so independently.
        """
        h, H, gradients = zip(*(
            self._field_of_one(x[:, first:first + self.n_one], time_offset)
            for first in range(0, self.n_target, self.n_one)), strict=True)
        # NaN where a dipole is on a sensor, as the field there: also where the length is zero.
        with np.errstate(invalid='ignore'):
            variance = sum(np.square(length)[:, None] * gradient**2 for length, gradient in zip(
                near_field_length.T, gradients, strict=True))
        return sum(h[1:], h[0]), np.concatenate(H, axis=3), np.asarray(variance)

    def _field_of_one(self, x: FloatArray, time_offset: FloatArray
                      ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Field of one target with the states `x` (n_hyp, n_one); see `sensor_fields`."""
        n_hyp, n, n_t = len(x), len(self.positions), self.n_one
        if not time_offset.any():
            return sensor_fields(self.positions, self.R_sw, *self._model.dipoles(x))
        h, H = np.empty((n_hyp, n, 3)), np.empty((n_hyp, n, 3, n_t))
        gradient = np.empty((n_hyp, n))
        steps = np.round(time_offset / SAME_TIME_S)
        for step in np.unique(steps):
            j = np.flatnonzero(steps == step)
            moved, F, _ = self._model.propagate(x, step * SAME_TIME_S)
            h[:, j], H_moved, gradient[:, j] = sensor_fields(
                self.positions[j], self.R_sw[j], *self._model.dipoles(moved))
            H[:, j] = H_moved @ (F if F.ndim == 2 else F[:, None])
        return h, H, gradient

    def field_of(self, x: FloatArray, targets: Iterable[int], time_offset: FloatArray
                 ) -> FloatArray:
        """(n_sensors, 3) [T] the field of some targets of a state (n_x,)."""
        n = self.n_one
        h, H = np.zeros((1, *self.positions.shape)), np.zeros((1, *self.positions.shape, 0))
        for target in targets:
            h = h + self._field_of_one(x[None, target * n:(target + 1) * n], time_offset)[0]
        if self.n_angles:
            h, _ = rotated_fields(h, H, np.ascontiguousarray(self.own(x[None])[..., :3]))
        field: FloatArray = h[0]
        return field

    def fields(self, x: FloatArray, time_offset: FloatArray, near_field_length: FloatArray,
               field_error: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fields as the sensors see them, without the backgrounds.

        Parameters
        ----------
        x : (n_hyp, n_x)
        time_offset : (n_sensors,) [s]
        near_field_length : (n_hyp, n_targets) [m]
        field_error : float
            Model error relative to the field.

        Returns
        -------
        h : (n_hyp, n_sensors, 3) [T], sensor frame
        H : (n_hyp, n_sensors, 3, n_target + n_own)
        inflation : (n_hyp, n_sensors) [T^2]
            Variance of the model error, where it is new in every frame; else 0.

        H leaves out that the size of the model error depends on the state, too: a few parts in
        a hundred of the derivative where the error is large. ICASSP11 eq. (9) for that size,
        there as noise.
        """
        h, H, variance = self.target_fields(x, time_offset, near_field_length)
        variance = variance + _share_of_field(h, field_error)
        own = self.own(x)
        if self.n_angles:
            h, H = rotated_fields(h, H, np.ascontiguousarray(own[..., :3]))
        if not self._error_time:
            return h, H, variance
        size = np.sqrt(variance)[:, :, None]
        h = h + size * own[..., -3:]
        H = np.concatenate([H, size[..., None] * np.eye(3)], axis=3)
        return h, H, np.zeros_like(variance)

    def model_error(self, x: FloatArray, near_field_length: FloatArray, field_error: float
                    ) -> FloatArray:
        """(n_sensors,) [T^2] Variance of what the models leave out of the field of a state (n_x,).

        `near_field_length` (n_targets,) [m]. NaN where a dipole is on a sensor.
        """
        h, _, variance = self.target_fields(x[None], np.zeros(len(self.positions)),
                                            near_field_length[None])
        return np.asarray(variance[0] + _share_of_field(h, field_error)[0])


def _share_of_field(h: FloatArray, field_error: float) -> FloatArray:
    """(n_hyp, n_sensors) [T^2] Variance of a model error that is a share of fields `h`."""
    variance: FloatArray = field_error**2 * np.einsum('pji,pji->pj', h, h)
    return variance
