"""Scenarios with truth: vehicles and magnets that move past a network.

A simulated vehicle is a cloud of magnetised parts, not one dipole, so that a
point model meets the model error that it will meet on a road; a matched point
target is a cloud of one part.
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
    """Something magnetic that moves upright over the ground."""

    def field(self, earth_field: FloatArray, position: FloatArray, heading: FloatArray,
              points: FloatArray) -> FloatArray:
        """Its field at `points`.

        Parameters
        ----------
        earth_field : (3,) [T], world
        position : (n, 2) [m], heading : (n,) [rad]
        points : (n_sensors, 3) [m], world

        Returns
        -------
        (n, n_sensors, 3) [T], world
        """
        ...


class Trajectory(Protocol):
    """Where a body is at any time."""

    def at(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Position (n, 2) [m] and heading (n,) [rad] at times `t` (n,) [s]."""
        ...


def body_poses(position: FloatArray, heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3), body to world, and origins (n, 3) [m] of a body on the ground.

    `position` (n, 2) [m] and `heading` (n,) [rad].
    """
    R = np.zeros((len(heading), 3, 3))
    R[:, 0, 0], R[:, 0, 1] = np.cos(heading), -np.sin(heading)
    R[:, 1, 0], R[:, 1, 1] = np.sin(heading), np.cos(heading)
    R[:, 2, 2] = 1.0
    return R, np.concatenate([position, np.zeros((len(heading), 1))], axis=1)


@dataclass(frozen=True)
class MagneticBody:
    """Parts fixed in a body frame (x forward, z up), origin on the ground."""

    parts: FloatArray
    """(n, 3) [m]."""
    permanent: FloatArray
    """(n, 3) [A m^2], hard iron of each part."""
    susceptibility: FloatArray
    """(n, 3, 3) [m^3]: induced moment = susceptibility @ B0 / mu0, body frame."""

    def field(self, earth_field: FloatArray, position: FloatArray, heading: FloatArray,
              points: FloatArray) -> FloatArray:
        """See `Body.field`."""
        R, origin = body_poses(position, heading)
        r = origin[:, None] + np.einsum('nij,pj->npi', R, self.parts)
        B_body = np.einsum('nji,j->ni', R, earth_field)
        induced = np.einsum('pij,nj->npi', self.susceptibility, B_body) / MU0
        m = np.einsum('nij,npj->npi', R, self.permanent + induced)
        B: FloatArray = dipole_field(points[None, :, None] - r[:, None], m[:, None]).sum(axis=2)
        return B


def point_body(hard_iron: Sequence[float] | FloatArray, soft_iron: float,
               height: float) -> MagneticBody:
    """A matched point target: m0 (3,) [A m^2], D [m^3], `height` [m] above the ground."""
    return MagneticBody(np.array([[0.0, 0.0, height]]), np.array([hard_iron], dtype=float),
                        soft_iron * np.eye(3)[None])


def random_vehicle(rng: np.random.Generator, length: float = 4.3, width: float = 1.7,
                   height: float = 1.3, n_parts: int = 60, moment: float = 400.0) -> MagneticBody:
    """A vehicle-like cloud: parts in a box, most of the iron low and at the ends.

    The permanent and the induced moment are each about `moment` / 1.4 in
    size for an earth field of 50 microtesla.
    """
    along = np.where(rng.random(n_parts) < 0.6,
                     rng.choice([-0.35, 0.35], n_parts) + 0.1 * rng.standard_normal(n_parts),
                     rng.uniform(-0.5, 0.5, n_parts))
    parts = np.stack([length * np.clip(along, -0.5, 0.5), width * rng.uniform(-0.5, 0.5, n_parts),
                      0.2 + (height - 0.2) * rng.beta(1.5, 3.0, n_parts)], axis=1)
    share = rng.dirichlet(np.full(n_parts, 1.5))
    common = rng.standard_normal(3)
    permanent = (share[:, None] * (common / np.linalg.norm(common)
                                   + 0.7 * rng.standard_normal((n_parts, 3)))
                 * moment / 1.4)
    # Iron sheets are easier to magnetise along the vehicle than across it.
    easy = np.array([1.3, 1.0, 0.7]) * rng.uniform(0.8, 1.2, (n_parts, 3))
    total = moment / 1.4 * MU0 / 50e-6
    susceptibility = np.einsum('n,ni,ij->nij', share * total, easy, np.eye(3))
    return MagneticBody(parts, permanent, susceptibility)


@dataclass(frozen=True)
class Path:
    """A planar path at constant speed: straight, or straight - arc - straight."""

    start: FloatArray
    """(2,) [m]."""
    heading: float
    """[rad] at the start."""
    speed: float
    """[m/s]."""
    straight: float = float('inf')
    """[m] before the arc."""
    turn: float = 0.0
    """[rad], anticlockwise positive."""
    radius: float = 1.0
    """[m]."""

    def at(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Position (n, 2) and heading (n,) at times `t` (n,) [s]."""
        s = self.speed * np.asarray(t, dtype=float)
        arc = abs(self.turn) * self.radius
        lead = np.minimum(s, self.straight)
        angle = np.clip((s - self.straight) / self.radius if self.turn else 0.0 * s,
                        0.0, abs(self.turn)) * np.sign(self.turn)
        tail = np.maximum(s - self.straight - arc, 0.0) if self.turn else 0.0 * s
        # In the frame of the start: forward and left.
        side = np.sign(self.turn)
        forward = lead + self.radius * np.sin(np.abs(angle)) + tail * np.cos(angle)
        left = side * self.radius * (1.0 - np.cos(angle)) + tail * np.sin(angle)
        c, w = np.cos(self.heading), np.sin(self.heading)
        position = self.start + np.stack([c * forward - w * left, w * forward + c * left], axis=1)
        return position, self.heading + angle


@dataclass(frozen=True)
class SensorErrorModel:
    """What real sensors add; zeros are perfect sensors."""

    noise_std: float = 1.2e-8
    """[T]."""
    bias_std: float = 0.0
    """[T], constant."""
    drift_std: float = 0.0
    """[T/s], constant slope."""
    tilt_std: float = 0.0
    """[rad], per axis: the mounting is off from what the network says."""
    clock_std: float = 0.0
    """[s], constant offset, not for the first sensor."""
    gain_std: float = 0.0
    """Of each axis, as a share of 1."""


def simulate(network: SensorNetwork, body: Body, path: Trajectory, rate: float, duration: float,
             rng: np.random.Generator, sensor_errors: SensorErrorModel | None = None,
             start_s: float = 0.0) -> tuple[Readings, FloatArray, FloatArray, FloatArray]:
    """Raw readings of every sensor and the truth, for one vehicle.

    Parameters
    ----------
    network : SensorNetwork
        With an earth field.
    body : Body
    path : Course
    rate : float [Hz]
    duration : float [s]
    rng : numpy.random.Generator
    imperfections : Imperfections, optional
    start_s : float [s]
        Stamp of the first sample.

    Returns
    -------
    readings : Readings, in order of their timestamps
    t : (n,) [s], position : (n, 2) [m], heading : (n,) [rad]
        The truth.

    Raises ValueError for a network without an earth field.
    """
    flaws, earth_field = sensor_errors or SensorErrorModel(), network.earth_field
    if earth_field is None:
        raise ValueError('the network has no earth field to simulate in')
    t = np.arange(0.0, duration, 1.0 / rate, dtype=float)
    fields = []
    for j in range(len(network)):
        offset = flaws.clock_std * rng.standard_normal() if j else 0.0
        position, heading = path.at(t + offset)
        B = earth_field + body.field(earth_field, position, heading,
                                     network.positions[j:j + 1])[:, 0]
        a, b, c = flaws.tilt_std * rng.standard_normal(3)
        tilt = np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]])
        y = B @ network.R_ws[j] @ tilt
        if flaws.gain_std:
            y *= 1.0 + flaws.gain_std * rng.standard_normal(3)
        y += flaws.bias_std * rng.standard_normal(3)
        y += flaws.drift_std * rng.standard_normal(3) * t[:, None]
        y += flaws.noise_std * rng.standard_normal(y.shape)
        fields.append(y)
    n = len(network)
    stamps = np.array([int(round((start_s + s) * 1e9)) for s in t], dtype=np.int64)
    readings = Readings(network.names, np.tile(np.arange(n), len(t)), np.repeat(stamps, n),
                        np.stack(fields, axis=1).reshape(-1, 3))
    return readings, t, *path.at(t)
