"""Orientation of sensors: tilt from accelerometers, heading from the Earth's field, and tracks.

The prior of the mounting errors is common to all tracks. The information that a track adds to the
prior is independent of other tracks and is summed over all tracks. The result is less accurate than
a calibration with a known target, because vehicle model errors are similar in all passes of a lane.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import (
    quaternion_between,
    quaternion_from_rotation_vector,
    rotation_about_z,
    rotation_from_quaternion,
    yaw_between,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Track

GRAVITY, MAX_GRAVITY_DIFFERENCE = 9.81, 1.0
"""[m/s²] Gravity, and maximum difference of the magnitude of the acceleration at rest."""
OUTLIER_STDS = 5.0
"""Distance from the median, in standard deviations, beyond which a reading is a knock."""
MAX_RIVAL_COST, MAX_EQUAL_COST = 9.0, 1.0
"""Maximum cost difference of a rival heading, and of equally good headings."""
MAX_HEADING_STD = np.deg2rad(60.0)
"""[rad] Maximum standard deviation of a heading."""
MIN_INFORMATION_FRACTION = 0.05
"""Minimum information about a compared direction, relative to the track's best-known direction."""


class UpDirection(NamedTuple):
    """Up direction of a sensor at rest, (3,) unit vector, sensor frame."""

    direction: FloatArray
    std: float
    """[rad] Standard deviation of the direction, about each level axis."""


def up_direction(acceleration: FloatArray, bias: float) -> UpDirection:
    """Up direction from accelerations (n, 3) in m/s² of a sensor at rest, which may contain knocks.

    `bias` is the std of the bias of the accelerometer per axis. Raises ValueError if fewer than 8
    readings are at rest, or their mean differs from gravity by more than `MAX_GRAVITY_DIFFERENCE`.
    """
    a = np.asarray(acceleration, dtype=float).reshape(-1, 3)
    finite = a[np.isfinite(a).all(axis=1)]
    if len(finite) < 8:
        raise ValueError(f'the tilt requires at least 8 valid accelerations, got {len(finite)}')
    distance = finite - np.median(finite, axis=0)
    scale = 1.4826 * np.median(np.abs(distance), axis=0)
    # The scatter of a coarse accelerometer at rest can be zero.
    is_at_rest = (np.abs(distance) <= OUTLIER_STDS * np.maximum(scale, 1e-3)).all(axis=1)
    at_rest = finite[is_at_rest]
    if len(at_rest) < 8:
        raise ValueError(f'only {len(at_rest)} of {len(finite)} accelerations are at rest, 8 are '
                         'required')
    mean = at_rest.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if abs(size - GRAVITY) > MAX_GRAVITY_DIFFERENCE:
        raise ValueError(f'the acceleration at rest is {size:.3g}, not {GRAVITY} m/s^2'
                         + (' (is its unit g?)' if 0.8 < size < 1.2 else ''))
    scatter = float(at_rest.std(axis=0).max()) / np.sqrt(len(at_rest))
    return UpDirection(mean / size, float(np.hypot(scatter, bias)) / GRAVITY)


@dataclass(frozen=True)
class Orientation:
    """Orientation of a sensor and its accuracy."""

    R_ws: FloatArray
    """(3, 3), sensor to world."""
    std: FloatArray
    """(3,) [rad] Standard deviations of small rotations about the world axes."""
    bias: FloatArray
    """(3,) [T], sensor frame: measured field minus the Earth's field, without the component across
    the heading, which the heading absorbs; NaN for an axis not reported."""
    rival: float
    """[rad] Angle to another heading that fits equally well; NaN if the heading is unique."""


def compass_orientation(up: UpDirection, field: FloatArray, earth_field: FloatArray,
                        bias_std: float, nominal: FloatArray | None = None) -> Orientation:
    """Orientation from the up direction and the field (3,), T, measured without a target.

    `bias_std` is per axis and includes nearby iron; a bias is not distinguishable from a heading
    error: 0.6 uT rotates a compass by two degrees. `nominal` (sensor to world) selects one of
    several headings that fit equally well (two for a sensor with one axis). Raises ValueError if
    the heading is not observable: the field is vertical, or no reported axis has a component across
    the horizontal field. [T10]_ section 6.3.1, eq. (6.2)-(6.9); the stds are an addition.
    """
    y, B0 = np.asarray(field, dtype=float), np.asarray(earth_field, dtype=float)
    is_reported = ~np.isnan(y)
    R_level = rotation_from_quaternion(quaternion_between(up.direction, [0.0, 0.0, 1.0]))
    across = np.cross([0.0, 0.0, 1.0], B0)

    def fit(yaw: float) -> tuple[FloatArray, FloatArray]:
        """Residuals of the reported axes [T], and derivatives of their fields by yaw [T/rad]."""
        R_sw = (rotation_about_z(yaw) @ R_level).T
        return (y - R_sw @ B0)[is_reported], -(R_sw @ across)[is_reported]

    yaws = [_refined_yaw(fit, start) for start in np.deg2rad(np.arange(0.0, 360.0, 30.0))]
    costs = np.array([np.sum(fit(yaw)[0]**2) for yaw in yaws]) / bias_std**2
    preference = costs if nominal is None else np.array(
        [abs(yaw_between(rotation_about_z(yaw) @ R_level, nominal)) for yaw in yaws])
    yaw = yaws[int(np.argmin(np.where(costs <= costs.min() + MAX_EQUAL_COST, preference, np.inf)))]
    slope = fit(yaw)[1]
    horizontal, vertical = np.hypot(*B0[:2]), abs(B0[2])
    information = slope @ slope / bias_std**2
    if information * MAX_HEADING_STD**2 <= 1.0:
        raise ValueError('the heading is not observable: the measured part of the horizontal field '
                         f'of {horizontal:.2g} T is too small for a bias of {bias_std:.2g} T')
    # A tilt error projects part of the vertical field onto the horizontal plane.
    heading_std = np.sqrt(1.0 / information + (up.std * vertical / horizontal)**2)
    differences = [np.angle(np.exp(1j * (other - yaw))) for other in yaws]
    rivals = [d for d, c in zip(differences, costs, strict=True)
              if abs(d) > 0.1 and c < costs.min() + MAX_RIVAL_COST]
    R_ws = rotation_about_z(yaw) @ R_level
    return Orientation(R_ws, np.array([up.std, up.std, heading_std]), y - R_ws.T @ B0,
                       min(rivals, key=abs) if rivals else float('nan'))


def _refined_yaw(fit: Callable[[float], tuple[FloatArray, FloatArray]], yaw: float) -> float:
    """Refine a yaw [rad] by Gauss-Newton steps of at most 0.5 rad."""
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


def levelled(up: UpDirection | None, nominal: FloatArray,
             nominal_std: FloatArray) -> Orientation | None:
    """Correct the tilt of a nominal orientation (3, 3) by a measured up direction, if any; heading
    and its std, `nominal_std[2]` in rad, are unchanged."""
    if up is None:
        return None
    correction = rotation_from_quaternion(
        quaternion_between(nominal @ up.direction, [0.0, 0.0, 1.0]))
    return Orientation(correction @ nominal, np.array([up.std, up.std, nominal_std[2]]),
                       np.full(3, np.nan), float('nan'))


def pooled_bias_std(orientations: Sequence[Orientation], bias_std: float,
                    weight: float = 4.0) -> float:
    """Standard deviation [T] of the biases in a network, which are not observable across the
    headings, with a prior `bias_std` of a `weight`."""
    square = sum(float(np.nansum(o.bias**2)) for o in orientations)
    n_observed = sum(np.count_nonzero(~np.isnan(o.bias)) - 1 for o in orientations)
    return float(np.sqrt((weight * bias_std**2 + square) / (weight + n_observed)))


def with_nominal_heading(orientation: Orientation, nominal: FloatArray,
                         nominal_std: float) -> Orientation | None:
    """Fuse a compass heading with a nominal one, std `nominal_std` rad; None beyond three std."""
    difference = yaw_between(orientation.R_ws, nominal)
    compass_std = orientation.std[2]
    if abs(difference) > 3.0 * np.hypot(compass_std, nominal_std):
        return None
    nominal_weight = compass_std**2 / (compass_std**2 + nominal_std**2)
    std = np.append(orientation.std[:2],
                    compass_std * nominal_std / np.hypot(compass_std, nominal_std))
    return Orientation(rotation_about_z(nominal_weight * difference) @ orientation.R_ws, std,
                       orientation.bias, orientation.rival)


@dataclass(frozen=True)
class MountingEvidence:
    """Corrections of the sensor orientations, fused from tracks."""

    rotation: FloatArray
    """(n_sensors, 3) [rad] small rotations about the world axes, which correct the orientations."""
    covariance: FloatArray
    """(n_sensors, 3, 3) [rad²] covariance of `rotation`, world axes."""
    scatter: FloatArray
    """(n_sensors,) chi-square per degree of freedom of the tracks relative to `rotation`; NaN for
    fewer than two tracks. Values above one scale the covariance."""
    n_tracks: int


def fuse_mounting(network: SensorNetwork, prior_std: Iterable[FloatArray],
                  tracks: Sequence[Track]) -> MountingEvidence:
    """Fuse the mounting angles that tracks estimate with priors (3,) [rad] about the world axes;
    raises ValueError for another number of sensors."""
    n = len(network)
    prior = np.array([np.diag(1.0 / np.square(std)) for std in prior_std])
    gains, vectors = np.zeros((len(tracks), n, 3, 3)), np.zeros((len(tracks), n, 3))
    for k, track in enumerate(tracks):
        if len(track.mounting) != n:
            raise ValueError(f'track {track.id} has mounting angles of {len(track.mounting)} '
                             f'sensors, expected {n}')
        # The angles rotate the field in the sensor frame; the sensor has the inverse rotation.
        rotation = -np.einsum('jik,jk->ji', network.R_ws, track.mounting)
        information = np.linalg.inv(network.R_ws @ track.mounting_covariance @ network.R_sw)
        values, axes = np.linalg.eigh(information - prior)
        gains[k] = np.einsum('jik,jk,jlk->jil', axes, np.maximum(values, 0.0), axes)
        # The prior mean is zero and adds nothing to the information vector.
        vectors[k] = np.einsum('jik,jk->ji', information, rotation)
    total_information, total_vector = prior + gains.sum(axis=0), vectors.sum(axis=0)
    covariance = np.linalg.inv(total_information)
    rotation = np.einsum('jik,jk->ji', covariance, total_vector)
    scatter = _track_scatter(gains, vectors, rotation, covariance) if len(tracks) > 1 \
        else np.full(n, np.nan)
    inflation = np.maximum(1.0, np.nan_to_num(scatter, nan=1.0))
    covariance = np.linalg.inv(prior + (total_information - prior) / inflation[:, None, None])
    rotation = np.einsum('jik,jk->ji', covariance, total_vector / inflation[:, None])
    return MountingEvidence(rotation, covariance, scatter, len(tracks))


def _track_scatter(gains: FloatArray, vectors: FloatArray, rotation: FloatArray,
                   covariance: FloatArray) -> FloatArray:
    """Chi-square per degree of freedom (n_sensors,) of single tracks about the fused angles; NaN
    without degrees of freedom."""
    squares, freedom = np.zeros(len(rotation)), np.zeros(len(rotation))
    for gain, vector in zip(gains, vectors, strict=True):
        residual = vector - np.einsum('jik,jk->ji', gain, rotation)
        inverse = np.linalg.pinv(gain, rcond=MIN_INFORMATION_FRACTION, hermitian=True)
        squares += np.einsum('ji,jik,jk->j', residual, inverse, residual)
        # The fused estimate includes the track, which reduces the degrees of freedom.
        projection = inverse @ gain
        freedom += np.einsum('jii->j', projection - projection @ covariance @ gain)
    scatter: FloatArray = np.divide(squares, freedom, out=np.full(len(rotation), np.nan),
                                    where=freedom > 1e-3)
    return scatter


def with_pass_mounting(network: SensorNetwork, evidence: MountingEvidence) -> SensorNetwork:
    """Copy the network with orientations and their stds corrected by fused mounting angles."""
    corrections = rotation_from_quaternion(quaternion_from_rotation_vector(evidence.rotation))
    std = np.sqrt(np.einsum('jii->ji', evidence.covariance))
    return replace(network, R_ws=corrections @ network.R_ws, orientation_std=tuple(std))
