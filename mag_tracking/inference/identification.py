"""Identification of enrolled vehicles by their hard and soft iron, at any heading."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.iron import Iron, hard_and_soft_iron
from mag_tracking.inference.log_normal_classes import UNKNOWN

PASS_TO_PASS_STD = 20.0
"""[A m^2] Moments of one vehicle differ by this between passes, on top of what their fits state
(T10 Table 6.9: 14, 18 and 21 on the three axes)."""

MIN_HEADING_SEPARATION = np.deg2rad(45.0)
"""[rad] Headings that are this far apart tell hard iron from soft iron."""

HEADING_TOLERANCE = np.deg2rad(10.0)
"""[rad] A vehicle that is enrolled at one heading is compared at that heading only."""

SIGNIFICANCE_LEVEL = 0.01
"""A moment that is less probable than this for every vehicle is of an unknown one."""


@dataclass(frozen=True)
class EnrolledVehicle:
    """A vehicle with its hard and soft iron, or with its moment at one heading."""

    name: str
    iron: Iron | None
    """None: its passes have one heading."""
    heading: float
    """[rad] of its passes, where they have one heading; else NaN."""
    moment: FloatArray
    """(3,) [A m^2], world, at that heading."""
    covariance: FloatArray
    """(3, 3) of `moment`."""

    def moment_at(self, heading: float, heading_std: float, induction: FloatArray
                  ) -> tuple[FloatArray, FloatArray] | None:
        """Moment of its next pass, and the covariance of what is predicted.

        Parameters
        ----------
        heading, heading_std : float, rad
        induction : (3,) array, A/m
            B0/mu0.

        Returns
        -------
        moment : (3,) array, A m^2, world
        covariance : (3, 3) array
            Without that of the measurement. None where it cannot be compared at this heading.

        References
        ----------
        [T10]_ eq. (6.16); [TSP14]_ eq. (15), (16).
        """
        between = PASS_TO_PASS_STD**2 * np.eye(3)
        if self.iron is None:
            if abs(_wrapped(heading - self.heading)) > HEADING_TOLERANCE:
                return None
            return self.moment, self.covariance + between
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        slope = np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 0.0]]) @ self.iron.hard
        A = np.hstack([R, induction[:, None]])
        return (R @ self.iron.hard + self.iron.soft * induction,
                A @ self.iron.covariance @ A.T + heading_std**2 * np.outer(slope, slope) + between)


@dataclass(frozen=True)
class Identification:
    """Which enrolled vehicle a pass is of."""

    name: str
    """The most probable vehicle; `UNKNOWN` where the moment fits none."""
    probabilities: dict[str, float]
    """{vehicle: probability}, for equal priors, of those that can be compared."""
    distances: dict[str, float]
    """{vehicle: squared Mahalanobis distance}, chi-square with three degrees of freedom."""
    not_compared: tuple[str, ...]
    """Vehicles that are enrolled at another heading only."""


def enrol(name: str, moments: FloatArray, covariances: FloatArray, headings: FloatArray,
          induction: FloatArray) -> EnrolledVehicle:
    """Enrol a vehicle by its passes.

    Parameters
    ----------
    name : str
    moments : (n, 3) array, A m^2, world
    covariances : (n, 3, 3) array
        As the fits state them; the spread between passes is added.
    headings : (n,) array, rad
    induction : (3,) array, A/m
        B0/mu0.

    Returns
    -------
    EnrolledVehicle

    Raises
    ------
    ValueError
        If there is no pass, or a number is not finite.
    """
    moments, headings = np.asarray(moments, dtype=float), np.asarray(headings, dtype=float)
    if not len(moments):
        raise ValueError(f'{name}: a vehicle is enrolled by at least one pass')
    spread = np.asarray(covariances, dtype=float) + PASS_TO_PASS_STD**2 * np.eye(3)
    apart = np.abs(_wrapped(headings[:, None] - headings)).max()
    if apart >= MIN_HEADING_SEPARATION:
        iron = hard_and_soft_iron(moments, headings, induction, spread)
        return EnrolledVehicle(name, iron, np.nan, np.full(3, np.nan), np.full((3, 3), np.nan))
    if not np.isfinite(moments).all() or apart > HEADING_TOLERANCE:
        raise ValueError(f'{name}: expected finite moments at one heading, or at headings that '
                         f'are {np.rad2deg(MIN_HEADING_SEPARATION):.0f} degrees apart; these are '
                         f'{np.rad2deg(apart):.0f} degrees apart')
    information = np.linalg.inv(spread)
    covariance = np.linalg.inv(information.sum(axis=0))
    mean = covariance @ np.einsum('nij,nj->i', information, moments)
    middle = float(np.angle(np.exp(1j * headings).sum()))
    return EnrolledVehicle(name, None, middle, mean, covariance)


def identify(vehicles: Sequence[EnrolledVehicle], moment: FloatArray, covariance: FloatArray,
             heading: float, heading_std: float, induction: FloatArray) -> Identification:
    """Which of the enrolled vehicles made a pass.

    Parameters
    ----------
    vehicles : sequence of EnrolledVehicle
    moment : (3,) array, A m^2, world
    covariance : (3, 3) array
    heading, heading_std : float, rad
    induction : (3,) array, A/m
        B0/mu0.

    Returns
    -------
    Identification
    """
    log_p, distances, others = {}, {}, []
    for vehicle in vehicles:
        predicted = vehicle.moment_at(heading, heading_std, induction)
        if predicted is None:
            others.append(vehicle.name)
            continue
        e, P = moment - predicted[0], predicted[1] + covariance
        distances[vehicle.name] = float(e @ np.linalg.solve(P, e))
        log_p[vehicle.name] = -0.5 * (distances[vehicle.name] + float(np.linalg.slogdet(P)[1]))
    if not log_p:
        return Identification(UNKNOWN, {}, {}, tuple(others))
    p = np.exp(np.array(list(log_p.values())) - max(log_p.values()))
    best = max(log_p, key=lambda name: log_p[name])
    return Identification(
        best if min(distances.values()) <= chdtri(3, SIGNIFICANCE_LEVEL) else UNKNOWN,
        dict(zip(log_p, (p / p.sum()).tolist(), strict=True)), distances, tuple(others))


def _wrapped(angle: FloatArray | float) -> FloatArray:
    """The same angle, between -pi and pi."""
    turned: FloatArray = np.angle(np.exp(1j * np.asarray(angle)))
    return turned
