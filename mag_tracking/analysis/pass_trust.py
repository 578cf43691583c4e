"""How far a fitted pass is to be trusted.

No row of dipoles is a vehicle: near it some of the field is left over, and what is left over says
little against the fit as long as it is where, and as much as, real vehicles leave. Speed,
direction and time of the closest point then have deviations of their own, and each is trusted or
not by those. The whole fit is refused only where something is not determined.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray

POINT_REACH = 2.1
"""[m] How far the iron of a car reaches from a single dipole: at the distance r this over r, as a
share of its size, is wrong about the field. Four real cars at 4.5 m had normalised costs of 10,
14, 17 and 51 (T10 Table 6.1, TSP14 Table I), the signal having 1200 times the energy of the noise
at the closest point (T10 (6.1)): 87 times a value, on average over the pass. So three of them left
over 10 to 18 % of the energy; the fourth, 57 %, is no pass of a point."""

ROW_REACH = 0.45
"""The same of a row, in distances of its dipoles: costs of 1.3 to 1.6 (cars) and 77 to 303 (trucks,
of twenty times the energy) with three dipoles (T10 Table 6.5, TSP14 Table II) are 0.15 to 0.45."""

MIN_ROW_REACH = 0.4
"""[m] However close the dipoles of a row: the cars of those tables."""

NOISE_ENERGY = 16.3
"""Whitened energy of three axes that noise exceeds once in a thousand samples."""

MIN_ELSEWHERE, MAX_ELSEWHERE = 0.003, 0.1
"""A vehicle leaves over up to this share of its field elsewhere (gains, a swerve), and up to this
share of all that it leaves over."""

MIN_DISTANCE = 0.3
"""Share of the distance of the nearest sensor that a target has to move while it is seen."""

MAX_CHANGE = 0.3
"""Share of itself by which the velocity may seem to change while the target is seen: 17 degrees of
a turn. Vehicles that are no rows of dipoles seem to change it by up to 0.2."""

SIGNIFICANT = 2.5
"""A change of the velocity that is larger than so many deviations is one."""

MAX_SPEED_STD = 0.25
"""A speed is trusted whose deviation is no larger than this share of it: it is not zero."""

MAX_HEADING_STD = np.pi / 6.0
"""[rad] A direction is trusted that three deviations do not turn to the side."""

MAX_TIME_STD = 0.25
"""A time of the closest point is trusted that is known to this share of the time in which the
target moves by its distance."""


def reach(n_dipoles: int, length: float) -> float:
    """[m] How far iron reaches beyond a row of `n_dipoles` over `length` [m]."""
    if n_dipoles == 1:
        return POINT_REACH
    return max(MIN_ROW_REACH, ROW_REACH * abs(length) / (n_dipoles - 1))


class FittedRow(NamedTuple):
    """A row of dipoles of a fit."""

    n_dipoles: int
    theta: FloatArray
    """(6 or 7,) the path: position at time zero, velocity, length."""
    field: FloatArray
    """(n, 3) [T], sensor frame."""


def residual_elsewhere(data: PassData, rows: Sequence[FittedRow], residuals: FloatArray) -> float:
    """Share of the whitened energy of the targets' field left over where no vehicle leaves it.

    A vehicle leaves something over in proportion to its field, and the more the nearer it is; a
    further vehicle does so at another time.

    Parameters
    ----------
    data : PassData
    rows : list of FittedRow
        The targets, `n` samples each.
    residuals : (n, 3)
        Whitened residuals.

    Returns
    -------
    float
        What is beyond ICASSP11 eq. (9), with `reach` for lambda, and beyond noise.
    """
    def energy(field: FloatArray) -> FloatArray:
        whitened = np.einsum('nij,nj->ni', data.whitening, field)
        size2: FloatArray = np.einsum('ni,ni->n', whitened, whitened)
        return size2

    known = sum((_residual_share(data, row) * energy(row.field) for row in rows),
                np.zeros(len(residuals)))
    beyond = np.square(residuals).sum(axis=1) - known - NOISE_ENERGY
    everything = energy(np.sum([row.field for row in rows], axis=0))
    return float(np.maximum(beyond, 0.0).sum() / everything.sum())


def _residual_share(data: PassData, row: FittedRow) -> FloatArray:
    """(n,) share of a target's energy that it may leave over in each sample."""
    n_dipoles, theta, _ = row
    v = theta[3:6]
    ahead = np.linspace(-0.5, 0.5, n_dipoles) * theta[6] if n_dipoles > 1 else np.zeros(1)
    forward = v / np.linalg.norm(v)
    place = theta[:3] + data.t[:, None] * v - data.positions
    distance = np.linalg.norm(place[:, None] + ahead[:, None] * forward, axis=2).min(axis=1)
    length = float(theta[6]) if n_dipoles > 1 else 0.0
    share: FloatArray = np.minimum(1.0, np.square(
        reach(n_dipoles, length) / np.maximum(distance, 1e-9)))
    return share


def doubt(fit: PassFit) -> str:
    """Why a minimum is no answer as a whole, or nothing."""
    if reason := _no_pass(fit):
        return reason
    if fit.bearing is not None:
        return ('one sensor: the scale is not observable, only directions and the time of the '
                'closest approach are (TSP14 Proposition 1)')
    lost = [name for name, variance in zip(fit.names, np.diagonal(fit.covariance), strict=True)
            if not np.isfinite(variance)]
    if lost:
        return f'not observable: {", ".join(lost)}'
    if not fit.determined:
        length, length_std = fit.length
        return (f'not determined: a length of {length:.1f} m, known to {length_std:.1f} m; '
                'take fewer dipoles')
    std, nearest = np.sqrt(np.trace(fit.robust_covariance[:3, :3])), _nearest(fit)
    if std > nearest:
        return (f'out of range: the position is known to {std:.1f} m only, and no sensor is nearer '
                f'than {nearest:.1f} m')
    return ''


def trusted(fit: PassFit) -> tuple[str, ...]:
    """Speed, direction and time: those that a minimum determines, whatever else it does not.

    None of a target that the model does not describe, or that turned or did not pass.
    """
    if _no_pass(fit) or fit.bearing is not None:
        return ()
    speed, speed_std = fit.speed
    _, heading_std = fit.heading
    nearest = _nearest(fit)
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    _, time_std, _, _ = fit.closest_approach(centre)
    # A comparison with NaN, where a variance is not known, is false.
    known = {'speed': speed_std <= MAX_SPEED_STD * speed,
             'direction': heading_std <= MAX_HEADING_STD and speed_std <= 0.5 * speed,
             'time': time_std * speed <= MAX_TIME_STD * nearest}
    return tuple(name for name, is_known in known.items() if is_known)


def _no_pass(fit: PassFit) -> str:
    """Why a minimum is no pass of one target at constant velocity, or nothing."""
    if not fit.converged:
        return 'the fit did not converge'
    if not describes(fit):
        return (f'not one target at constant velocity: {1.0 - fit.explained:.1%} of the field is '
                f'left over, {fit.residual_elsewhere:.1%} where a vehicle at that distance '
                'leaves none '
                '(another vehicle, a turn, a wrong network file)')
    if turns(fit):
        return ('not at constant velocity: while it was seen it changed by '
                f'{fit.velocity_change:.0%} of itself (a turn, braking)')
    if np.linalg.norm(fit.velocity) * fit.duration_s < MIN_DISTANCE * _nearest(fit):
        return 'no pass: while it was seen it hardly moved'
    return ''


def describes(fit: PassFit) -> bool:
    """Whether what is left over is where real vehicles leave it."""
    limit = max(MIN_ELSEWHERE, MAX_ELSEWHERE * (1.0 - fit.explained))
    return fit.residual_elsewhere <= limit


def turns(fit: PassFit) -> bool:
    """Whether the velocity changes by much, and by more than errors of the model make it seem."""
    return bool(fit.velocity_change > max(MAX_CHANGE, SIGNIFICANT * fit.velocity_change_std))


def contradicted(fit: PassFit) -> bool:
    """Whether a fit says that there was not one target on a straight line, whatever the order."""
    return fit.n_dipoles > 1 and (turns(fit) or not describes(fit))


def _nearest(fit: PassFit) -> float:
    """[m] How near the middle of the target comes to a sensor."""
    return min(fit.closest_approach(place)[2]
               for place in fit.data.network.positions[fit.data.sensors])
