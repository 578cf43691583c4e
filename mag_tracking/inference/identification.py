"""Identification of enrolled vehicles by their hard and soft iron, at any heading."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.iron import Iron, hard_and_soft_iron
from mag_tracking.inference.log_normal_classes import UNKNOWN

PASS_TO_PASS_STD = 20.0
"""Standard deviation of the moment of one vehicle between passes [A m²], in addition to the
covariance of the fits (T10 Table 6.9: 14, 18 and 21 on the three axes)."""

MIN_HEADING_SEPARATION = np.deg2rad(45.0)
"""Minimum difference of headings that separates hard from soft iron [rad]."""

HEADING_TOLERANCE = np.deg2rad(10.0)
"""[rad] Maximum difference of headings at which a pass is compared with a vehicle that is enrolled
at a single heading."""

SIGNIFICANCE_LEVEL = 0.01
"""Significance level of the chi-square test; a moment rejected for every vehicle is unknown."""


@dataclass(frozen=True)
class EnrolledVehicle:
    """A vehicle with its hard and soft iron, or with its moment at a single heading."""

    name: str
    """Name of the vehicle."""
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
        """Predict the moment (3,) [A m², world frame] of a pass at a heading, and its covariance.

        `field_strength` is B0/mu0 [A/m, world frame]. The measurement noise is not included. None
        if the vehicle was enrolled at another heading only. T10 eq. (6.16); TSP14 eq. (15), (16).
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
    not_compared: tuple[str, ...]
    """Vehicles that are enrolled at another heading only."""


def enrol(name: str, moments: FloatArray, covariances: FloatArray, headings: FloatArray,
          field_strength: FloatArray) -> EnrolledVehicle:
    """Enrol a vehicle from fitted moments (n, 3) [A m², world frame] of passes at known headings.

    The variance between passes is added to `covariances`; `field_strength` is B0/mu0 [A/m, world].
    Raises ValueError if there is no pass, a value is not finite, or the headings neither agree nor
    differ by at least `MIN_HEADING_SEPARATION`.
    """
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
    """Identify the enrolled vehicle of a pass by its fitted moment (3,) [A m², world frame].

    `heading` is in the world frame; `field_strength` is B0/mu0 [A/m, world frame].
    """
    log_p, distances, skipped = {}, {}, []
    for vehicle in vehicles:
        predicted = vehicle.moment_at(heading, heading_std, field_strength)
        if predicted is None:
            skipped.append(vehicle.name)
            continue
        e, P = moment - predicted[0], predicted[1] + covariance
        distances[vehicle.name] = float(e @ np.linalg.solve(P, e))
        log_p[vehicle.name] = -0.5 * (distances[vehicle.name] + float(np.linalg.slogdet(P)[1]))
    if not log_p:
        return Identification(UNKNOWN, {}, {}, tuple(skipped))
    p = np.exp(np.array(list(log_p.values())) - max(log_p.values()))
    best = max(log_p, key=lambda name: log_p[name])
    return Identification(
        best if min(distances.values()) <= chdtri(3, SIGNIFICANCE_LEVEL) else UNKNOWN,
        dict(zip(log_p, (p / p.sum()).tolist(), strict=True)), distances, tuple(skipped))


def _wrapped(angle: FloatArray | float) -> FloatArray:
    """Angle wrapped to the interval from -pi to pi."""
    wrapped: FloatArray = np.angle(np.exp(1j * np.asarray(angle)))
    return wrapped
