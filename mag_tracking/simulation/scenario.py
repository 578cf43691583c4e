"""Simulated scenarios with ground truth: bodies that move past a sensor network.

A simulated vehicle is a cloud of magnetised parts rather than one dipole, so that a point-target
model has a realistic model error. A single part is a point target that matches this model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0, dipole_field
from mag_tracking.records import Readings


class Body(Protocol):
    """A magnetic body that moves upright over the ground."""

    def field(self, earth_field: FloatArray, position: FloatArray, heading: FloatArray,
              points: FloatArray) -> FloatArray:
        """Field of the body at given points.

        Parameters
        ----------
        earth_field : (3,) array, T, world frame
            Flux density B0.
        position : (n, 2) array, m, world frame
            Horizontal position of the body at each time.
        heading : (n,) array, rad
            Heading at each time, anticlockwise from x.
        points : (n_sensors, 3) array, m, world frame
            Positions at which the field is evaluated.

        Returns
        -------
        (n, n_sensors, 3) array, T, world frame
        """
        ...


class Trajectory(Protocol):
    """Pose of a body as a function of time."""

    def at(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Evaluate the trajectory.

        Parameters
        ----------
        t : (n,) array, s
            Times.

        Returns
        -------
        position : (n, 2) array, m, world frame
            Horizontal position.
        heading : (n,) array, rad
            Anticlockwise from x.
        """
        ...


def body_poses(position: FloatArray, heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) from body to world frame, and origins (n, 3) [m] at z = 0, on the ground.

    `position` (n, 2) [m] is horizontal, `heading` (n,) [rad] anticlockwise from x.
    """
    R = np.zeros((len(heading), 3, 3))
    R[:, 0, 0], R[:, 0, 1] = np.cos(heading), -np.sin(heading)
    R[:, 1, 0], R[:, 1, 1] = np.sin(heading), np.cos(heading)
    R[:, 2, 2] = 1.0
    return R, np.concatenate([position, np.zeros((len(heading), 1))], axis=1)


@dataclass(frozen=True)
class MagneticBody:
    """Magnetised parts fixed in a body frame (x forward, z up) with its origin on the ground."""

    parts: FloatArray
    """Positions of the parts, (n, 3) m, body frame."""
    permanent: FloatArray
    """Hard iron moment of each part, (n, 3) A m², body frame."""
    susceptibility: FloatArray
    """Soft iron of each part, (n, 3, 3) m³, body frame: induced moment = susceptibility @ B0 / mu0.
    """

    def field(self, earth_field: FloatArray, position: FloatArray, heading: FloatArray,
              points: FloatArray) -> FloatArray:
        """Field of the body, as `Body.field`; NaN at a point that coincides with a part."""
        R, origin = body_poses(position, heading)
        r = origin[:, None] + np.einsum('nij,pj->npi', R, self.parts)
        B_body = np.einsum('nji,j->ni', R, earth_field)
        induced = np.einsum('pij,nj->npi', self.susceptibility, B_body) / MU0
        m = np.einsum('nij,npj->npi', R, self.permanent + induced)
        B: FloatArray = dipole_field(points[None, :, None] - r[:, None], m[:, None]).sum(axis=2)
        return B


def point_body(hard_iron: Sequence[float] | FloatArray, soft_iron: float,
               height: float) -> MagneticBody:
    """Create a point target that matches the model of the tracker.

    `hard_iron` (3,) [A m²] is the moment m0 in the body frame, `soft_iron` [m³] the value D of all
    axes, `height` [m] that above the ground.
    """
    return MagneticBody(np.array([[0.0, 0.0, height]]), np.array([hard_iron], dtype=float),
                        soft_iron * np.eye(3)[None])


def random_vehicle(rng: np.random.Generator, length: float = 4.3, width: float = 1.7,
                   height: float = 1.3, n_parts: int = 60, moment: float = 400.0) -> MagneticBody:
    """Create a vehicle of randomly magnetised parts in a box of `length`, `width` and `height` [m].

    Most parts are in the lower half of the box and near its ends. `moment` [A m²] is the typical
    total moment: the permanent and the induced moment are each about `moment` / 1.4 if the Earth's
    field is 50 microtesla.
    """
    along = np.where(rng.random(n_parts) < 0.6,
                     rng.choice([-0.35, 0.35], n_parts) + 0.1 * rng.standard_normal(n_parts),
                     rng.uniform(-0.5, 0.5, n_parts))
    parts = np.stack([length * np.clip(along, -0.5, 0.5), width * rng.uniform(-0.5, 0.5, n_parts),
                      0.2 + (height - 0.2) * rng.beta(1.5, 3.0, n_parts)], axis=1)
    fractions = rng.dirichlet(np.full(n_parts, 1.5))
    common_direction = rng.standard_normal(3)
    permanent = (fractions[:, None] * (common_direction / np.linalg.norm(common_direction)
                                       + 0.7 * rng.standard_normal((n_parts, 3)))
                 * moment / 1.4)
    # Sheet metal is easier to magnetise along the vehicle than across it.
    axis_factors = np.array([1.3, 1.0, 0.7]) * rng.uniform(0.8, 1.2, (n_parts, 3))
    total_susceptibility = moment / 1.4 * MU0 / 50e-6
    susceptibility = np.einsum('n,ni,ij->nij', fractions * total_susceptibility, axis_factors,
                               np.eye(3))
    return MagneticBody(parts, permanent, susceptibility)


@dataclass(frozen=True)
class Path:
    """Planar path at constant speed: straight, or straight - arc - straight."""

    start: FloatArray
    """Position at t = 0, (2,) m, world frame."""
    heading: float
    """Heading at the start, rad, anticlockwise from x."""
    speed: float
    """Speed, m/s."""
    straight: float = float('inf')
    """Length of the straight segment before the arc, m."""
    turn: float = 0.0
    """Angle of the arc, rad, positive for a left turn; 0 selects a straight path."""
    radius: float = 1.0
    """Radius of the arc, m."""

    def at(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Evaluate the trajectory, as `Trajectory.at`."""
        s = self.speed * np.asarray(t, dtype=float)
        arc = abs(self.turn) * self.radius
        before_arc = np.minimum(s, self.straight)
        angle = np.clip((s - self.straight) / self.radius if self.turn else 0.0 * s,
                        0.0, abs(self.turn)) * np.sign(self.turn)
        after_arc = np.maximum(s - self.straight - arc, 0.0) if self.turn else 0.0 * s
        # In the frame of the start pose: x forward, y left.
        turn_sign = np.sign(self.turn)
        forward = before_arc + self.radius * np.sin(np.abs(angle)) + after_arc * np.cos(angle)
        sideways = turn_sign * self.radius * (1.0 - np.cos(angle)) + after_arc * np.sin(angle)
        c, w = np.cos(self.heading), np.sin(self.heading)
        position = self.start + np.stack([c * forward - w * sideways,
                                          w * forward + c * sideways], axis=1)
        return position, self.heading + angle


@dataclass(frozen=True)
class SensorErrorModel:
    """Standard deviations of random sensor errors; zero disables an error."""

    noise_std: float = 1.2e-8
    """White noise, T."""
    bias_std: float = 0.0
    """Constant bias, T."""
    drift_std: float = 0.0
    """Constant drift rate, T/s."""
    tilt_std: float = 0.0
    """Mounting error about each axis, relative to the network file, rad."""
    clock_std: float = 0.0
    """Constant clock offset, s; 0 for the first sensor."""
    gain_std: float = 0.0
    """Relative gain error of each axis."""


def simulate(network: SensorNetwork, body: Body, path: Trajectory, rate: float, duration: float,
             rng: np.random.Generator, sensor_errors: SensorErrorModel | None = None,
             start_s: float = 0.0) -> tuple[Readings, FloatArray, FloatArray, FloatArray]:
    """Simulate the raw readings of all sensors for one body, with ground truth.

    The samples at `rate` [Hz] begin at the timestamp `start_s` [s]. By default, the only sensor
    error is white noise. Return the readings in chronological order, the time (n,) [s] of each
    sample since the start, and the true position (n, 2) [m] and heading (n,) [rad] at these times.
    Raises ValueError if the network has no Earth's field.
    """
    errors, earth_field = sensor_errors or SensorErrorModel(), network.earth_field
    if earth_field is None:
        raise ValueError('the simulation requires a network with an earth field; set earth_field')
    t = np.arange(0.0, duration, 1.0 / rate, dtype=float)
    fields = []
    for j in range(len(network)):
        offset = errors.clock_std * rng.standard_normal() if j else 0.0
        position, heading = path.at(t + offset)
        B = earth_field + body.field(earth_field, position, heading,
                                     network.positions[j:j + 1])[:, 0]
        a, b, c = errors.tilt_std * rng.standard_normal(3)
        tilt = np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]])
        y = B @ network.R_ws[j] @ tilt
        if errors.gain_std:
            y *= 1.0 + errors.gain_std * rng.standard_normal(3)
        y += errors.bias_std * rng.standard_normal(3)
        y += errors.drift_std * rng.standard_normal(3) * t[:, None]
        y += errors.noise_std * rng.standard_normal(y.shape)
        fields.append(y)
    n = len(network)
    stamps = np.array([int(round((start_s + s) * 1e9)) for s in t], dtype=np.int64)
    readings = Readings(network.names, np.tile(np.arange(n), len(t)), np.repeat(stamps, n),
                        np.stack(fields, axis=1).reshape(-1, 3))
    return readings, t, *path.at(t)
