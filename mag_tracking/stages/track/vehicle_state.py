"""States of vehicles that were found on straight paths."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import rotation_about_z
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.stages.track.initiation_vehicle import (
    START_TURN_RATIO,
    VehicleSettings,
    soft_iron,
    starting_covariance,
    vehicle_model,
)

MIN_MOMENT = 1e-6
"""[A m^2] Minimum magnitude of a moment at which its direction is defined."""


@dataclass(frozen=True)
class VehicleState:
    """Conversion of straight paths (`PATH` of `steady_pass`) to states of `RowVehicle`."""

    settings: VehicleSettings
    network: SensorNetwork
    background_std: float
    """[T] Standard deviation of each background."""

    @cached_property
    def _model(self) -> RowVehicle:
        """Vehicle model of the settings."""
        return vehicle_model(self.settings, self.network)

    @property
    def _n_dipoles(self) -> int:
        """Number of dipoles of a vehicle."""
        return self._model.n_dipoles

    @property
    def length_column(self) -> int | None:
        """Column of the length in the state of a vehicle; None if all vehicles are points."""
        return 9 + 3 * self._n_dipoles if self._n_dipoles > 1 else None

    def prior(self, theta: FloatArray, moments: FloatArray, t: float, kind: int, label: int
              ) -> tuple[FloatArray, FloatArray]:
        """Mean (n_t,) and covariance (n_t, n_t) of a vehicle that arrives on a path `theta` (7,),
        at time `t` [s] on it.

        The mean lies on the path, and its moment has the estimated direction, that of `moments`
        (k, 3) [A m², world frame]. All other values equal the prior at the start of a track.
        """
        s = self.settings
        R = rotation_about_z(float(np.deg2rad(s.arrival_headings_deg[label])))
        total = moments.sum(axis=0)
        mean = s.kinds[kind].moment * total / max(float(np.linalg.norm(total)), MIN_MOMENT)
        x = self.along(theta, mean[None], np.array([t]), kind)[0]
        x[2], x[5] = s.kinds[kind].height, 0.0
        if self._n_dipoles > 1:
            x[9 + 3 * self._n_dipoles] = s.kinds[kind].length
        return x, starting_covariance(s, kind, R, float(theta[3]), s.kinds[kind].moment_std)

    def along(self, theta: FloatArray, moments: FloatArray, times: FloatArray, kind: int
              ) -> FloatArray:
        """States (n, n_t) at `times` [s] on a straight path `theta` (7,), for a row of dipoles with
        `moments` (k, 3) from the tail to the head, A m², world frame."""
        d, s, length = self._n_dipoles, self.settings, float(theta[6])
        heading = float(theta[4])
        R = rotation_about_z(heading)
        soft_D = soft_iron(s, kind)
        x = np.zeros((len(times), len(self._model.state_names)))
        velocity = np.array([theta[3] * np.cos(heading), theta[3] * np.sin(heading), theta[5]])
        x[:, :3], x[:, 3:6] = theta[:3] + times[:, None] * velocity, velocity
        ordered = moments[::-1] if length < 0.0 else moments
        is_point = s.kinds[kind].length_std == 0.0
        dipole_moments = np.tile(moments.sum(axis=0) / d, (d, 1)) if is_point \
            else _resampled(ordered, d)
        induced = soft_D * self._model.field_strength
        x[:, 6:6 + 3 * d] = (dipole_moments @ R - induced @ R / d).ravel()
        x[:, 6 + 3 * d:9 + 3 * d] = soft_D
        if d > 1:
            x[:, 9 + 3 * d] = s.kinds[kind].length if is_point else abs(length)
        return x

    def hard_moments(self, x: FloatArray) -> FloatArray:
        """Hard iron moments (d, 3) of the dipoles of a vehicle with state `x` (n_t,), A m², vehicle
        frame."""
        hard: FloatArray = x[6:6 + 3 * self._n_dipoles].reshape(-1, 3)
        return hard

    def turning(self, x: FloatArray, P: FloatArray, target: int) -> FloatArray | None:
        """Return `P` with the turn-rate variance of one target set to its initial value; None if
        turning is disabled.

        The state `x` (n_x,) contains several targets.
        """
        if not self._model.turn_acceleration:
            return None
        n = len(self._model.state_names)
        first, w = target * n, (target + 1) * n - 1
        out = P.copy()
        out[w, w] = START_TURN_RATIO**2 * self._model.turn_variance(
            np.hypot(x[first + 3], x[first + 4]))
        return out


def _resampled(moments: FloatArray, d: int) -> FloatArray:
    """Resample `moments` (k, 3) to `d` dipoles (d, 3); the total and the centroid are preserved."""
    if len(moments) == 1 or d == 1:
        return np.tile(moments.sum(axis=0) / d, (d, 1))
    coordinates = np.linspace(0.0, d - 1.0, len(moments))
    weights = np.maximum(1.0 - np.abs(coordinates - np.arange(d)[:, None]), 0.0)
    resampled: FloatArray = weights @ moments
    return resampled
