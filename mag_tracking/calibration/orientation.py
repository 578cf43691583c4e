"""How a sensor is mounted: tilt from its accelerometer, heading from the Earth's field.

Source: T10 section 6.3.1, eq. (6.2)-(6.9); how well each is known is this package's own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import (
    quaternion_between,
    rotation_about_z,
    rotation_from_quaternion,
    yaw_between,
)

GRAVITY = 9.81
"""[m/s^2], to a percent anywhere on Earth."""

FARTHEST = 1.0
"""[m/s^2] What is at rest and differs more from gravity is no accelerometer in m/s^2."""

OUTLYING = 5.0
"""Readings farther from the median than so many deviations are knocks, and left out."""

RIVAL = 9.0
"""Another heading whose cost is less than this above the best is as good as that."""

ALIKE = 1.0
"""Headings whose costs differ by no more fit alike: which is nearer to what was stated decides."""

UNKNOWN = np.deg2rad(60.0)
"""[rad] A heading that is less certain than this is none."""

_Fit: TypeAlias = Callable[[float], tuple[FloatArray, FloatArray]]
"""Of a yaw [rad] the residual and the field's derivative by it, both (n,)."""


@dataclass(frozen=True)
class Up:
    """Where up is for a sensor at rest."""

    direction: FloatArray
    """(3,) unit vector, sensor frame."""
    size: float
    """[m/s^2] of gravity as the sensor measures it."""
    std: float
    """[rad] of the direction, about each level axis."""
    n: int
    """Readings used."""
    n_left_out: int
    """Readings that were knocks, or not finite."""


def up_direction(acceleration: FloatArray, bias: float) -> Up:
    """Where up is, by a sensor at rest: what it measures then is the reaction to gravity.

    Parameters
    ----------
    acceleration : (n, 3) [m/s^2], sensor frame
        Knocks may be in it.
    bias : float [m/s^2]
        What the accelerometer may be off by, on each axis.

    Returns
    -------
    Up

    Raises ValueError with fewer than 8 readings, and where gravity is not there.
    """
    a = np.asarray(acceleration, dtype=float).reshape(-1, 3)
    finite = a[np.isfinite(a).all(axis=1)]
    if len(finite) < 8:
        raise ValueError(f'{len(finite)} accelerations are too few to tell the tilt; 8 would do')
    deviation = finite - np.median(finite, axis=0)
    scale = 1.4826 * np.median(np.abs(deviation), axis=0)
    # An accelerometer of coarse steps at rest has no scatter at all.
    quiet = (np.abs(deviation) <= OUTLYING * np.maximum(scale, 1e-3)).all(axis=1)
    used = finite[quiet]
    if len(used) < 8:
        raise ValueError(f'only {len(used)} of {len(finite)} accelerations are at rest')
    mean = used.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if abs(size - GRAVITY) > FARTHEST:
        raise ValueError(f'the acceleration at rest is {size:.3g}, not {GRAVITY} m/s^2'
                         + (' (in g?)' if 0.8 < size < 1.2 else ''))
    scatter = float(used.std(axis=0).max()) / np.sqrt(len(used))
    return Up(mean / size, size, float(np.hypot(scatter, bias)) / GRAVITY, len(used),
              len(a) - len(used))


@dataclass(frozen=True)
class Orientation:
    """How a sensor is turned, and how well that is known."""

    R_ws: FloatArray
    """(3, 3), sensor to world."""
    std: FloatArray
    """(3,) [rad] of small rotations about the world's axes."""
    bias: FloatArray
    """(3,) [T], sensor frame: measured less the Earth's field; NaN of an axis not reported. Of it
    the part across the heading was taken for heading."""
    rival: float
    """[rad] Another heading that fits as well, from this one; NaN where there is none."""


def compass_orientation(up: Up, field: FloatArray, earth_field: FloatArray, bias_std: float,
                        stated: FloatArray | None = None) -> Orientation:
    """The orientation of a sensor from where up is and the Earth's field.

    Parameters
    ----------
    up : Up
    field : (3,) [T], sensor frame
        Without a target. NaN = axis not reported.
    earth_field : (3,) [T], world (z up)
    bias_std : float [T]
        What the sensor and iron near it add to the Earth's field, on each axis. It
        cannot be told from a heading: 0.6 uT turns a compass by two degrees.
    stated : (3, 3), sensor to world, optional
        Of headings that fit alike (a sensor with one axis sees two) the nearest to this; without
        it the best.

    Returns
    -------
    Orientation

    Raises ValueError where the field does not tell the heading: straight up or
    down, or no axis across it.
    """
    y, B0 = np.asarray(field, dtype=float), np.asarray(earth_field, dtype=float)
    there = ~np.isnan(y)
    R_level = rotation_from_quaternion(quaternion_between(up.direction, [0.0, 0.0, 1.0]))
    across = np.cross([0.0, 0.0, 1.0], B0)

    def fit(yaw: float) -> tuple[FloatArray, FloatArray]:
        """Residual on the axes that are there, and the field's derivative by the yaw."""
        R_sw = (rotation_about_z(yaw) @ R_level).T
        return (y - R_sw @ B0)[there], -(R_sw @ across)[there]

    yaws = [_refined(fit, start) for start in np.deg2rad(np.arange(0.0, 360.0, 30.0))]
    costs = np.array([np.sum(fit(yaw)[0]**2) for yaw in yaws]) / bias_std**2
    away = costs if stated is None else np.array(
        [abs(yaw_between(rotation_about_z(yaw) @ R_level, stated)) for yaw in yaws])
    yaw = yaws[int(np.argmin(np.where(costs <= costs.min() + ALIKE, away, np.inf)))]
    slope = fit(yaw)[1]
    level, upright = np.hypot(*B0[:2]), abs(B0[2])
    information = slope @ slope / bias_std**2
    if information * UNKNOWN**2 <= 1.0:
        raise ValueError(f'the field does not tell the heading: of the {level:.2g} T across the '
                         f'vertical too little is seen against {bias_std:.2g} T of unknown bias')
    # A tilt that is wrong takes some of the upright field for level.
    heading_std = np.sqrt(1.0 / information + (up.std * upright / level)**2)
    others = [np.angle(np.exp(1j * (other - yaw))) for other in yaws]
    rivals = [d for d, c in zip(others, costs, strict=True)
              if abs(d) > 0.1 and c < costs.min() + RIVAL]
    R_ws = rotation_about_z(yaw) @ R_level
    return Orientation(R_ws, np.array([up.std, up.std, heading_std]), y - R_ws.T @ B0,
                       min(rivals, key=abs) if rivals else float('nan'))


def _refined(fit: _Fit, yaw: float) -> float:
    """The yaw where Gauss-Newton steps, none above half a radian, lead."""
    for _ in range(30):
        residual, slope = fit(yaw)
        square = slope @ slope
        if square == 0.0:
            break
        step = float(np.clip(slope @ residual / square, -0.5, 0.5))
        yaw += step
        if abs(step) < 1e-12:
            break
    return yaw


def levelled(up: Up | None, stated: FloatArray, stated_std: FloatArray) -> Orientation | None:
    """A stated orientation, tilted so that up is up.

    Parameters
    ----------
    up : Up or None
    stated : (3, 3), sensor to world
    stated_std : (3,) [rad], about the world's axes

    Returns
    -------
    Orientation, with a bias of NaN; None without `up`.
    """
    if up is None:
        return None
    turn = rotation_from_quaternion(quaternion_between(stated @ up.direction, [0.0, 0.0, 1.0]))
    return Orientation(turn @ stated, np.array([up.std, up.std, stated_std[2]]),
                       np.full(3, np.nan), float('nan'))


def pooled_bias_std(orientations: Sequence[Orientation], bias_std: float,
                    weight: float = 4.0) -> float:
    """[T] How large the biases of a network's sensors are, by what can be seen of them.

    Parameters
    ----------
    orientations : list of Orientation
    bias_std : float [T]
        What was expected; it counts as `weight` values.
    weight : float

    The bias along the heading and the upright one are seen, that across the
    heading is not: of the axes of each sensor one less are counted.
    """
    square = sum(float(np.nansum(o.bias**2)) for o in orientations)
    seen = sum(np.count_nonzero(~np.isnan(o.bias)) - 1 for o in orientations)
    return float(np.sqrt((weight * bias_std**2 + square) / (weight + seen)))


def with_stated_heading(orientation: Orientation, stated: FloatArray, stated_std: float,
                        limit: float = 3.0) -> Orientation | None:
    """Heading by the compass and by what an installer stated, each as good as it is.

    Parameters
    ----------
    orientation : Orientation
        By accelerometer and compass.
    stated : (3, 3), sensor to world
    stated_std : float [rad]
        How far it may be turned about the vertical.
    limit : float
        Where the two differ by more deviations than this, what was stated is wrong.

    Returns
    -------
    Orientation, or None where they differ by more.
    """
    difference = yaw_between(orientation.R_ws, stated)
    compass = orientation.std[2]
    if abs(difference) > limit * np.hypot(compass, stated_std):
        return None
    share = compass**2 / (compass**2 + stated_std**2)
    std = np.append(orientation.std[:2], compass * stated_std / np.hypot(compass, stated_std))
    return Orientation(rotation_about_z(share * difference) @ orientation.R_ws, std,
                       orientation.bias, orientation.rival)
