"""Second vehicle simulator: uniformly magnetised boxes and plates, computed by magpylib.

The first simulator scatters magnetised points. This simulator builds a body of sheets, an engine,
axles and frame rails. Each part is a cuboid with permanent and induced magnetisation. The induced
magnetisation depends on the shape: a sheet is magnetised in its plane, an axle along its length.
The driver brakes and swerves, and the sensors have gain errors. No parameter was tuned to the
tracker's models.
"""

from dataclasses import dataclass

import magpylib
import numpy as np

from mag_tracking.physics.dipole import MU0
from mag_tracking.simulation.scenario import Path, body_poses
from support.passes import EARTH
from support.scenario import SensorErrorModel

UNCALIBRATED = SensorErrorModel(noise_std=1.2e-8, tilt_std=np.deg2rad(1.0), gain_std=0.01)
"""Errors of uncalibrated sensors that are mounted carefully."""

SHEET = 0.01
"""[m] Thickness of a sheet; it hardly affects the external field."""

CHI = 60.0
"""Apparent susceptibility of iron without demagnetisation; low, because parts have gaps."""


@dataclass(frozen=True)
class BoxVehicle:
    """Cuboids in a body frame (x forward, z up) with its origin on the ground below the centre."""

    centres: np.ndarray
    """Centre of each cuboid, (n, 3) m."""
    sides: np.ndarray
    """Side lengths of each cuboid, (n, 3) m."""
    permanent: np.ndarray
    """Permanent moment of each cuboid, (n, 3) A m²."""
    induced: np.ndarray
    """Induced moment of each cuboid is `induced` * B0 / mu0, (n, 3) m³, body frame."""
    length: float
    """Length of the vehicle, m."""

    def moments(self, B_body):
        """Moments (k, n, 3) [A m²] of the cuboids in ambient fields (k, 3) [T], body frame."""
        return self.permanent + self.induced * B_body[:, None] / MU0

    def field(self, earth_field, position, heading, points):
        """Field of the vehicle at `points`; a body of `support.scenario`."""
        R, origin = body_poses(position, heading)
        m = self.moments(np.einsum('nji,j->ni', R, earth_field))
        J = MU0 * m / self.sides.prod(axis=1)[:, None]
        in_body = np.einsum('nji,nsj->nsi', R, points[None] - origin[:, None])
        k, n_points, n = len(heading), len(points), len(self.sides)
        observers = in_body[:, :, None] - self.centres
        shape = (k, n_points, n, 3)
        B = magpylib.getB(
            'Cuboid', observers.reshape(-1, 3),
            dimension=np.broadcast_to(self.sides, shape).reshape(-1, 3),
            polarization=np.broadcast_to(J[:, None], shape).reshape(-1, 3))
        return np.einsum('nij,nsj->nsi', R, B.reshape(shape).sum(axis=2))


def magnetised(rng, parts, length, moment):
    """Create a `BoxVehicle` from [(centre, sides, weight)] with a total `moment` [A m²]."""
    # The total moment is defined for a heading along x in `EARTH`, as measured on real vehicles
    # (TSP14 Table V). The permanent and the induced part are about `moment` / 1.4 each.
    centres, sides, weights = (np.array(column, dtype=float) for column in zip(*parts, strict=True))
    fraction = weights * rng.lognormal(0.0, 0.4, len(weights))
    fraction /= fraction.sum()
    # Approximation: demagnetisation along a side is inversely proportional to the side length.
    N = (1.0 / sides) / (1.0 / sides).sum(axis=1, keepdims=True)
    susceptibility = 1.0 / (N + 1.0 / CHI)
    shares = susceptibility * fraction[:, None] / susceptibility.mean(axis=1, keepdims=True)
    induced = shares * moment / 1.4 * MU0 / 50e-6
    while True:
        common = rng.standard_normal(3)
        along = common / np.linalg.norm(common) + 0.6 * rng.standard_normal((len(fraction), 3))
        permanent = fraction[:, None] * along * moment / 1.4
        total = np.linalg.norm((permanent + induced * EARTH / MU0).sum(axis=0))
        # Parts that nearly cancel are drawn again; scaling them up would be unrealistic.
        if total > 0.6 * moment:
            return BoxVehicle(centres, sides, permanent * moment / total,
                              induced * moment / total, length)


def box_car(rng, length=None, moment=None):
    """Random car with floor, roof, bonnet, boot, sides, engine and two axles."""
    length = rng.uniform(3.6, 4.8) if length is None else length
    width, height = rng.uniform(1.55, 1.85), rng.uniform(1.35, 1.7)
    rear = 1.0 if rng.random() < 0.85 else -1.0
    parts = [((0.0, 0.0, 0.25), (0.9 * length, 0.9 * width, SHEET), 2.5),
             ((-0.05 * length, 0.0, height), (0.4 * length, 0.8 * width, SHEET), 1.0),
             ((0.36 * length, 0.0, 0.85), (0.24 * length, 0.85 * width, SHEET), 0.8),
             ((-0.4 * length, 0.0, 0.9), (0.16 * length, 0.85 * width, SHEET), 0.6)]
    parts += [((0.0, 0.5 * side * width, 0.6), (0.8 * length, SHEET, 0.6), 1.2) for side in (-1, 1)]
    parts += [((0.33 * rear * length, 0.0, 0.55), (0.6, 0.6, 0.45), 2.5)]
    parts += [((0.3 * end * length, 0.0, 0.3), (0.08, 0.9 * width, 0.08), 0.7) for end in (-1, 1)]
    return magnetised(rng, parts, length, rng.uniform(300.0, 600.0) if moment is None else moment)


def box_truck(rng, length=None, moment=None):
    """Random truck with frame rails, cab, engine and axles, and a bed, a steel box or a load."""
    length = rng.uniform(7.0, 16.0) if length is None else length
    width, front = rng.uniform(2.3, 2.55), 0.5 * length
    parts = [((0.0, side * 0.4, 0.85), (0.95 * length, 0.08, 0.25), 2.0) for side in (-1, 1)]
    parts += [((front - 1.1, 0.0, 2.7), (1.8, 0.9 * width, SHEET), 0.5),
              ((front - 1.1, 0.0, 1.0), (1.8, 0.9 * width, SHEET), 0.8),
              ((front - 1.2, 0.0, 0.9), (1.1, 0.8, 0.8), 2.5)]
    parts += [((front - 1.1, 0.5 * side * width, 1.7), (1.8, SHEET, 1.4), 0.5) for side in (-1, 1)]
    rear = [-front + 1.0 + 1.3 * k for k in range(int(rng.integers(1, 4)))]
    parts += [((x, 0.0, 0.5), (0.14, 0.9 * width, 0.14), 1.0) for x in [front - 1.4, *rear]]
    bed, middle = length - 2.6, -1.3
    kind = rng.integers(3)
    if kind != 2:
        parts += [((middle, 0.0, 1.15), (bed, 0.95 * width, SHEET), 2.0)]
    if kind == 1:
        parts += [((middle, 0.5 * side * width, 2.4), (bed, SHEET, 2.4), 1.5) for side in (-1, 1)]
    if kind == 2:
        at = rng.uniform(-front + 1.5, front - 4.0)
        parts += [((at, 0.0, 1.6), (2.0, 1.8, 0.9), 3.0)]
    return magnetised(rng, parts, length,
                      rng.uniform(1200.0, 2200.0) if moment is None else moment)


@dataclass(frozen=True)
class Drive:
    """Course along a `Path` on which the speed changes once and the vehicle swerves once."""

    path: Path
    speed_change: float = 0.0
    """Relative change of the speed, negative for braking."""
    speed_change_at_s: float = 0.0
    """[s] Middle of the speed change."""
    speed_change_s: float = 2.0
    """[s] Approximate duration of the speed change."""
    swerve_m: float = 0.0
    """[m] Lateral displacement of the swerve, positive to the left."""
    swerve_at_s: float = 0.0
    """[s] Middle of the swerve."""
    swerve_s: float = 2.0
    """[s] Approximate duration of the swerve."""

    def _on_path(self, t):
        """Times (n,) [s] at which `path` reaches the distances travelled at the times `t`."""
        width = self.speed_change_s / 4.0
        z, z0 = (t - self.speed_change_at_s) / width, -self.speed_change_at_s / width
        # This is the integral of a logistic step.
        return t + self.speed_change * width * (np.logaddexp(0.0, z) - np.logaddexp(0.0, z0))

    def speed(self, t):
        """Speed along the path [m/s] at times (n,)."""
        z = (np.asarray(t, dtype=float) - self.speed_change_at_s) / (self.speed_change_s / 4.0)
        return self.path.speed * (1.0 + self.speed_change / (1.0 + np.exp(-z)))

    def at(self, t):
        """Position and heading at times `t`; a path of `support.scenario`."""
        t = np.asarray(t, dtype=float)
        position, heading = self.path.at(self._on_path(t))
        z = (t - self.swerve_at_s) / (self.swerve_s / 2.0)
        offset = self.swerve_m * np.exp(-0.5 * z * z)
        slope = -offset * z / (self.swerve_s / 2.0) / self.speed(t)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        return position + offset[:, None] * left, heading + np.arctan(slope)


def random_drive(rng, path, at):
    """Random `Drive` that changes speed by -20 to 10 % and swerves by up to 0.4 m near `at` [s]."""
    return Drive(path, speed_change=rng.uniform(-0.2, 0.1),
                 speed_change_at_s=at + rng.uniform(-2.0, 2.0),
                 speed_change_s=rng.uniform(1.5, 4.0), swerve_m=rng.uniform(-0.4, 0.4),
                 swerve_at_s=at + rng.uniform(-2.0, 2.0), swerve_s=rng.uniform(1.5, 4.0))
