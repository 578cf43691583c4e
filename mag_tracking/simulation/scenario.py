"""Simulated scenarios: bodies that move past a sensor network.

A simulated vehicle is a cloud of magnetised parts rather than one dipole, so that a point-target
model has a realistic model error. A single part is a point target that matches this model.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.dipole import MU0, dipole_field


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
        """Field (n, n_sensors, 3) [T] at `points` (n_sensors, 3) [m] of the body at horizontal
        positions (n, 2) [m] with headings (n,) [rad, anticlockwise from x], all in the world frame;
        NaN at a point that coincides with a part."""
        R, origin = body_poses(position, heading)
        r = origin[:, None] + np.einsum('nij,pj->npi', R, self.parts)
        B_body = np.einsum('nji,j->ni', R, earth_field)
        induced = np.einsum('pij,nj->npi', self.susceptibility, B_body) / MU0
        m = np.einsum('nij,npj->npi', R, self.permanent + induced)
        B: FloatArray = dipole_field(points[None, :, None] - r[:, None], m[:, None]).sum(axis=2)
        return B


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
        """Positions (n, 2) [m] and headings (n,) [rad] at times `t` (n,) [s]."""
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
