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
"""[A m^2] A smaller moment has no direction."""


@dataclass(frozen=True)
class VehicleState:
    """States of `RowVehicle` of the settings, from straight paths (`PATH` of `steady_pass`)."""

    settings: VehicleSettings
    network: SensorNetwork
    background_std: float
    """[T] Of each background."""

    @cached_property
    def _model(self) -> RowVehicle:
        """The model of the settings."""
        return vehicle_model(self.settings, self.network)

    @property
    def _d(self) -> int:
        """Dipoles of a vehicle."""
        return self._model.n_dipoles

    @property
    def length_column(self) -> int | None:
        """Of the length among the states of a vehicle; None where all are points."""
        return 9 + 3 * self._d if self._d > 1 else None

    def prior(self, theta: FloatArray, moments: FloatArray, t: float, kind: int, label: int
              ) -> tuple[FloatArray, FloatArray]:
        """What is known of a vehicle that comes about here, before anything is measured.

        As where a track starts, but that the direction of its moment is about the one found.

        Parameters
        ----------
        theta : (7,)
            A straight path.
        moments : (k, 3) [A m^2], world
            Those that were found.
        t : float [s]
            The time on that path.
        kind, label : int
            Kind of vehicle, and arrival.

        Returns
        -------
        x : (n_t,)
        P : (n_t, n_t)
        """
        s = self.settings
        R = rotation_about_z(float(np.deg2rad(s.arrival_headings_deg[label])))
        found = moments.sum(axis=0)
        mean = s.moments[kind] * found / max(float(np.linalg.norm(found)), MIN_MOMENT)
        x = self.along(theta, mean[None], np.array([t]), kind)[0]
        x[2], x[5] = s.heights[kind], 0.0
        if self._d > 1:
            x[9 + 3 * self._d] = s.lengths[kind]
        return x, starting_covariance(s, kind, R, float(theta[3]), s.moment_stds[kind])

    def along(self, theta: FloatArray, moments: FloatArray, times: FloatArray, kind: int
              ) -> FloatArray:
        """States (n, n_t) on a straight path theta (7,) at the `times` (n,) [s].

        `moments` (k, 3) [A m^2, world] of a row of k dipoles, from the tail to the head.
        """
        d, s, length = self._d, self.settings, float(theta[6])
        heading = float(theta[4])
        R = rotation_about_z(heading)
        soft = soft_iron(s, kind)
        x = np.zeros((len(times), len(self._model.state_names)))
        velocity = np.array([theta[3] * np.cos(heading), theta[3] * np.sin(heading), theta[5]])
        x[:, :3], x[:, 3:6] = theta[:3] + times[:, None] * velocity, velocity
        ordered = moments[::-1] if length < 0.0 else moments
        is_point = s.length_stds[kind] == 0.0
        each = np.tile(moments.sum(axis=0) / d, (d, 1)) if is_point else _spread(ordered, d)
        x[:, 6:6 + 3 * d] = (each @ R - soft * self._model.induction @ R / d).ravel()
        x[:, 6 + 3 * d:9 + 3 * d] = soft
        if d > 1:
            x[:, 9 + 3 * d] = s.lengths[kind] if is_point else abs(length)
        return x

    def hard_moments(self, x: FloatArray) -> FloatArray:
        """(d, 3) [A m^2] of a state (n_t,), in the vehicle's frame."""
        hard: FloatArray = x[6:6 + 3 * self._d].reshape(-1, 3)
        return hard

    def turning(self, x: FloatArray, P: FloatArray, target: int) -> FloatArray | None:
        """The covariance (n_x, n_x) with one target turning; None where none can turn.

        `x` (n_x,) are states of several targets.
        """
        if not self._model.turn_acceleration:
            return None
        n = len(self._model.state_names)
        first, w = target * n, (target + 1) * n - 1
        out = P.copy()
        out[w, w] = START_TURN_RATIO**2 * self._model.turn_variance(
            np.hypot(x[first + 3], x[first + 4]))
        return out


def _spread(moments: FloatArray, d: int) -> FloatArray:
    """Moments (d, 3) of a row of `d` dipoles with the same total and middle as `moments` (k, 3)."""
    if len(moments) == 1 or d == 1:
        return np.tile(moments.sum(axis=0) / d, (d, 1))
    places = np.linspace(0.0, d - 1.0, len(moments))
    share = np.maximum(1.0 - np.abs(places - np.arange(d)[:, None]), 0.0)
    spread: FloatArray = share @ moments
    return spread
