"""Identity of vehicles: classes, hard and soft iron, and enrolled vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, softmax

from mag_tracking.arrays import FloatArray

UNKNOWN = 'unknown'
"""Name that is returned for an object that matches no class."""
SIGNIFICANCE_LEVEL = 0.01
"""Significance level of the chi-square tests; what every class or vehicle rejects is `UNKNOWN`."""


class Feature(NamedTuple):
    """A measured positive feature and its distribution in each class."""

    value: float
    std: float
    medians: Sequence[float]
    spreads: Sequence[float]
    """Standard deviation of the natural logarithm of the feature in each class."""


class ClassPosterior(NamedTuple):
    """Most probable class of an object, and the probabilities of all classes."""

    name: str
    """Most probable class; `UNKNOWN` if the object matches no class."""
    probabilities: FloatArray
    """Posterior probabilities, (n_classes,), in the order of the class names."""


def class_posterior(names: Sequence[str], shares: Sequence[float],
                    features: Sequence[Feature]) -> ClassPosterior:
    """Classify an object by independent features; `shares` are the prior weights of the classes."""
    measured = np.log([f.value for f in features])
    relative = np.array([f.std / f.value for f in features])
    variance = np.square(np.array([f.spreads for f in features])) + np.square(relative)[:, None]
    centres = np.log(np.array([f.medians for f in features]))
    distance = (np.square(measured[:, None] - centres) / variance).sum(axis=0)
    log_p = np.log(np.array(shares)) - 0.5 * distance - 0.5 * np.log(variance).sum(axis=0)
    p = np.exp(log_p - log_p.max())
    best = int(np.argmax(p))
    is_known = distance.min() <= chdtri(len(features), SIGNIFICANCE_LEVEL)
    return ClassPosterior(names[best] if is_known else UNKNOWN, p / p.sum())


@dataclass(frozen=True)
class Iron:
    """Hard and soft iron of a vehicle, with covariance."""

    hard: FloatArray
    """Hard iron moment m0, (3,) A m², vehicle frame (x forward, z up)."""
    soft: float
    """Soft iron D, m³."""
    covariance: FloatArray
    """Covariance of [m0, D], (4, 4), in the squared units of m0 [A m²] and D [m³]."""
    normalised_cost: float
    """Chi-square of the residuals per degree of freedom; about 1 if the model is correct."""


def hard_and_soft_iron(moments: ArrayLike, headings: ArrayLike, field_strength: ArrayLike,
                       covariances: ArrayLike) -> Iron:
    """Estimate m0 and D in m = Rz(heading) m0 + D field_strength by least squares.

    `moments` (n, 3) [A m²] and `field_strength` = B0/mu0 [A/m] are in the world frame; with 3
    B0/mu0, D is as defined in T10. TSP14 section VI.E; T10 eq. (6.16).
    """
    moments, headings, field_strength, covariances = (
        np.asarray(a, dtype=float) for a in (moments, headings, field_strength, covariances))
    n = len(headings)
    if not (np.isfinite(moments).all() and np.isfinite(headings).all()
            and np.isfinite(field_strength).all()):
        raise ValueError('moments, headings and field_strength must be finite')
    A = np.zeros((n, 3, 4))
    c, s = np.cos(headings), np.sin(headings)
    A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = c, -s, s, c
    A[:, 2, 2] = 1.0
    A[:, :, 3] = field_strength
    try:
        W = np.linalg.inv(np.linalg.cholesky(covariances))
    except np.linalg.LinAlgError:
        raise ValueError('a covariance is not positive definite') from None
    whitened = (W @ A).reshape(3 * n, 4)
    # The units of m0 and D differ, so the columns are normalised first.
    scale = np.linalg.norm(whitened, axis=0)
    # Headings a hundredth of a degree apart are treated as equal.
    if (n < 2 or not (scale > 0.0).all()
            or np.linalg.svd(whitened / scale, compute_uv=False)[-1] < 1e-4):
        raise ValueError('hard and soft iron cannot be separated: headings must differ and the '
                         'earth field must have a horizontal component')
    y = (W @ moments[:, :, None]).ravel()
    theta = np.linalg.lstsq(whitened / scale, y, rcond=None)[0] / scale
    covariance = np.linalg.inv((whitened / scale).T @ (whitened / scale)) / np.outer(scale, scale)
    residual = y - whitened @ theta
    return Iron(theta[:3], float(theta[3]), covariance, float(residual @ residual) / (3 * n - 4))


PASS_TO_PASS_STD = 20.0
"""Standard deviation of the moment of one vehicle between passes [A m²], in addition to the
covariance of the fits (T10 Table 6.9: 14, 18 and 21 on the three axes)."""
MIN_HEADING_SEPARATION = np.deg2rad(45.0)
"""Minimum difference of headings that separates hard from soft iron [rad]."""
HEADING_TOLERANCE = np.deg2rad(10.0)
"""[rad] Maximum difference of the headings of a pass and of a vehicle enrolled at one heading."""


@dataclass(frozen=True)
class EnrolledVehicle:
    """A vehicle with its hard and soft iron, or with its moment at a single heading."""

    name: str
    iron: Iron | None
    """Hard and soft iron; None if all passes have about the same heading."""
    heading: float
    """Mean heading of the passes, rad, world frame; NaN if `iron` is known."""
    moment: FloatArray
    """Moment at `heading`, (3,) A m², world frame; NaN if `iron` is known."""
    covariance: FloatArray
    """Covariance of `moment`, (3, 3) A² m⁴; NaN if `iron` is known."""

    def moment_at(self, heading: float, heading_std: float, field_strength: FloatArray
                  ) -> tuple[FloatArray, FloatArray] | None:
        """Predict the moment (3,) [A m², world frame] of a pass at a heading, and its covariance
        without measurement noise.

        None if the vehicle was enrolled at another heading only. `field_strength` is B0/mu0 [A/m,
        world frame]. T10 eq. (6.16); TSP14 eq. (15), (16).
        """
        pass_to_pass = PASS_TO_PASS_STD**2 * np.eye(3)
        if self.iron is None:
            if abs(_wrapped(heading - self.heading)) > HEADING_TOLERANCE:
                return None
            return self.moment, self.covariance + pass_to_pass
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        slope = np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 0.0]]) @ self.iron.hard
        A = np.hstack([R, field_strength[:, None]])
        return (R @ self.iron.hard + self.iron.soft * field_strength,
                A @ self.iron.covariance @ A.T + heading_std**2 * np.outer(slope, slope)
                + pass_to_pass)


@dataclass(frozen=True)
class Identification:
    """Comparison of a pass with the enrolled vehicles."""

    name: str
    """The most probable vehicle; `UNKNOWN` if the moment matches none of the compared vehicles."""
    probabilities: dict[str, float]
    """{vehicle: probability} of the compared vehicles, for equal priors."""
    distances: dict[str, float]
    """{vehicle: squared Mahalanobis distance}; chi-square distributed with three degrees of freedom
    for the true vehicle."""


def enrol(name: str, moments: FloatArray, covariances: FloatArray, headings: FloatArray,
          field_strength: FloatArray) -> EnrolledVehicle:
    """Enrol a vehicle from fitted moments (n, 3) [A m², world frame] of passes at headings that
    agree, or differ by at least `MIN_HEADING_SEPARATION`."""
    moments, headings = np.asarray(moments, dtype=float), np.asarray(headings, dtype=float)
    if not len(moments):
        raise ValueError(f'{name}: enrolment requires at least one pass')
    total_covariances = np.asarray(covariances, dtype=float) + PASS_TO_PASS_STD**2 * np.eye(3)
    separation = np.abs(_wrapped(headings[:, None] - headings)).max()
    if separation >= MIN_HEADING_SEPARATION:
        iron = hard_and_soft_iron(moments, headings, field_strength, total_covariances)
        return EnrolledVehicle(name, iron, np.nan, np.full(3, np.nan), np.full((3, 3), np.nan))
    if not np.isfinite(moments).all() or separation > HEADING_TOLERANCE:
        raise ValueError(f'{name}: expected finite moments at one heading, or at headings at least '
                         f'{np.rad2deg(MIN_HEADING_SEPARATION):.0f} degrees apart; got headings '
                         f'{np.rad2deg(separation):.0f} degrees apart')
    information = np.linalg.inv(total_covariances)
    covariance = np.linalg.inv(information.sum(axis=0))
    mean = covariance @ np.einsum('nij,nj->i', information, moments)
    mean_heading = float(np.angle(np.exp(1j * headings).sum()))
    return EnrolledVehicle(name, None, mean_heading, mean, covariance)


def identify(vehicles: Sequence[EnrolledVehicle], moment: FloatArray, covariance: FloatArray,
             heading: float, heading_std: float, field_strength: FloatArray) -> Identification:
    """Identify the enrolled vehicle of a pass by its fitted moment (3,) [A m², world frame]."""
    log_p, distances = {}, {}
    for vehicle in vehicles:
        predicted = vehicle.moment_at(heading, heading_std, field_strength)
        if predicted is None:
            continue
        e, P = moment - predicted[0], predicted[1] + covariance
        distances[vehicle.name] = float(e @ np.linalg.solve(P, e))
        log_p[vehicle.name] = -0.5 * (distances[vehicle.name] + float(np.linalg.slogdet(P)[1]))
    if not log_p:
        return Identification(UNKNOWN, {}, {})
    p = softmax(list(log_p.values()))
    best = max(log_p, key=lambda name: log_p[name])
    return Identification(
        best if min(distances.values()) <= chdtri(3, SIGNIFICANCE_LEVEL) else UNKNOWN,
        dict(zip(log_p, p.tolist(), strict=True)), distances)


def _wrapped(angle: FloatArray | float) -> FloatArray:
    """Angle wrapped to the interval from -pi to pi."""
    return np.angle(np.exp(1j * np.asarray(angle)))
