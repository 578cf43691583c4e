"""Plausibility of a fitted pass and of the speed, direction and time that it determines.

A row of dipoles approximates a vehicle, and part of the near field remains unexplained. This
residual does not reject a fit if its location and magnitude are typical of real vehicles.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.physics.bounds import ADVICE, impossible_reason

POINT_REACH = 2.1
"""[m] Reach of the iron of a car from a single dipole. At distance r, the model error relative to
the field is the reach over r. Four real cars at 4.5 m had normalised costs of 10, 14, 17 and 51
(T10 Table 6.1, TSP14 Table I). Their signal energy was 1200 times the noise energy at the CPA (T10
eq. (6.1)), or 87 times per value on average over the pass. Three cars left 10 to 18 % of the energy
unexplained; the fourth, with 57 %, cannot be modelled as a point."""
ROW_REACH, MIN_ROW_REACH = 0.45, 0.4
"""Reach of the iron from a row, relative to the spacing of its dipoles, and at least [m] (from the
cars). With three dipoles, T10 Table 6.5 and TSP14 Table II report costs of 1.3 to 1.6 for cars, and
of 77 to 303 for trucks with twenty times the energy. These costs correspond to 0.15 to 0.45."""
NOISE_ENERGY = 16.3
"""Whitened energy of three axes that noise exceeds with a probability of 0.001."""
MAX_FIELD_ENERGY_ELSEWHERE, MAX_RESIDUAL_ENERGY_ELSEWHERE = 0.003, 0.1
"""Maximum unexplained energy outside the reach of a vehicle, the larger limit applies: fraction of
the field energy (gain errors, a swerve), and fraction of the total residual."""
MIN_PASS_DISTANCE = 0.3
"""Minimum distance travelled during a pass, relative to the distance of the nearest sensor."""
MAX_VELOCITY_CHANGE, MIN_VELOCITY_CHANGE_STDS = 0.3, 2.5
"""Maximum relative change of the velocity (a turn of 17 degrees; model errors of vehicles cause up
to 0.2), and minimum significant change in standard deviations."""
MAX_SPEED_STD, MAX_HEADING_STD, MAX_TIME_STD = 0.25, np.pi / 6.0, 0.25
"""Maximum standard deviation of a trusted speed relative to the speed, of a direction [rad], and of
a CPA time relative to the distance of the nearest sensor over the speed."""


class FittedRow(NamedTuple):
    """A fitted row of dipoles: path (6 or 7,), and field (n, 3) [T, sensor frame] at samples."""

    n_dipoles: int
    theta: FloatArray
    field: FloatArray


def reach(n_dipoles: int, length: float) -> float:
    """Maximum distance [m] between the iron of a vehicle and the dipoles that model it."""
    if n_dipoles == 1:
        return POINT_REACH
    return max(MIN_ROW_REACH, ROW_REACH * abs(length) / (n_dipoles - 1))


def residual_elsewhere(data: PassData, rows: Sequence[FittedRow], residuals: FloatArray) -> float:
    """Unexplained fraction of the whitened energy of all targets, outside the reach of vehicles.

    It is the energy in excess of the noise and of the model error of ICASSP11 eq. (9), with `reach`
    in place of lambda; an additional vehicle leaves such a residual.
    """
    def energy(field: FloatArray) -> FloatArray:
        whitened = np.einsum('nij,nj->ni', data.whitening, field)
        squared_norm: FloatArray = np.einsum('ni,ni->n', whitened, whitened)
        return squared_norm

    plausible_energy = np.zeros(len(residuals))
    for n_dipoles, theta, field in rows:
        v, length = theta[3:6], float(theta[6]) if n_dipoles > 1 else 0.0
        positions = theta[:3] + data.t[:, None] * v - data.positions
        dipoles = (np.linspace(-0.5, 0.5, n_dipoles) * length)[:, None] * (v / np.linalg.norm(v))
        distance = np.linalg.norm(positions[:, None] + dipoles, axis=2).min(axis=1)
        plausible_energy += energy(field) * np.minimum(1.0, np.square(
            reach(n_dipoles, length) / np.maximum(distance, 1e-9)))
    excess_energy = np.square(residuals).sum(axis=1) - plausible_energy - NOISE_ENERGY
    total_energy = energy(np.sum([row.field for row in rows], axis=0))
    return float(np.maximum(excess_energy, 0.0).sum() / total_energy.sum())


def rejection_reason(fit: PassFit) -> str:
    """Reason why a fit as a whole is rejected; empty if it is accepted."""
    if reason := _invalid_pass_reason(fit):
        return reason
    if fit.bearing is not None:
        return ('one sensor: the scale is not observable; only the directions and the time of the '
                'closest approach are determined (TSP14 Proposition 1)')
    unobservable = [name for name, variance in zip(
        fit.names, np.diagonal(fit.covariance), strict=True) if not np.isfinite(variance)]
    if unobservable:
        return f'not observable: {", ".join(unobservable)}'
    if not fit.determined:
        length, length_std = fit.length
        return (f'not determined: a length of {length:.1f} m with a standard deviation of '
                f'{length_std:.1f} m; use fewer dipoles')
    std, nearest_range = np.sqrt(np.trace(fit.robust_covariance[:3, :3])), _nearest_cpa_range(fit)
    if std > nearest_range:
        return (f'out of range: the position has a standard deviation of {std:.1f} m, and the '
                f'nearest sensor is {nearest_range:.1f} m away')
    return ''


def trusted_quantities(fit: PassFit) -> tuple[str, ...]:
    """Those of speed, direction and time (of the CPA) whose uncertainty is acceptable; none for a
    single sensor, or if the pass is not one target at constant velocity."""
    if _invalid_pass_reason(fit) or fit.bearing is not None:
        return ()
    speed, speed_std = fit.speed
    _, heading_std = fit.heading
    nearest_range = _nearest_cpa_range(fit)
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    _, time_std, _, _ = fit.closest_approach(centre)
    # A comparison with NaN (an unknown variance) is false.
    is_determined = {
        'speed': speed_std <= MAX_SPEED_STD * speed,
        'direction': heading_std <= MAX_HEADING_STD and speed_std <= 0.5 * speed,
        'time': time_std * speed <= MAX_TIME_STD * nearest_range}
    return tuple(name for name, is_valid in is_determined.items() if is_valid)


def _invalid_pass_reason(fit: PassFit) -> str:
    """Reason why a fit does not show one target at constant velocity; empty if it does."""
    if fit.data.doubt:
        return fit.data.doubt
    if not fit.converged:
        return 'the fit did not converge'
    if reason := impossible_reason(fit.velocity, fit.moment[0]):
        return f'{reason}; {ADVICE}'
    if not has_plausible_residual(fit):
        return (f'not one target at constant velocity: {1.0 - fit.explained:.1%} of the field is '
                f'unexplained, {fit.residual_elsewhere:.1%} where a vehicle at that distance '
                'leaves no residual; possible causes are another vehicle, a turn or a wrong '
                'network file')
    if has_velocity_change(fit):
        return ('not at constant velocity: the velocity changed by '
                f'{fit.velocity_change:.0%} during the pass (a turn, braking)')
    if np.linalg.norm(fit.velocity) * fit.duration_s < MIN_PASS_DISTANCE * _nearest_cpa_range(fit):
        return 'no pass: the distance travelled is too short'
    return ''


def has_plausible_residual(fit: PassFit) -> bool:
    """Whether `residual_elsewhere` of a fit is within the limit for a vehicle."""
    limit = max(MAX_FIELD_ENERGY_ELSEWHERE, MAX_RESIDUAL_ENERGY_ELSEWHERE * (1.0 - fit.explained))
    return fit.residual_elsewhere <= limit


def has_velocity_change(fit: PassFit) -> bool:
    """Whether the change of the velocity is too large to be caused by model errors."""
    return bool(fit.velocity_change > max(
        MAX_VELOCITY_CHANGE, MIN_VELOCITY_CHANGE_STDS * fit.velocity_change_std))


def contradicts_straight_pass(fit: PassFit) -> bool:
    """Whether a fit of several dipoles rules out a single target at constant velocity."""
    return fit.n_dipoles > 1 and (has_velocity_change(fit) or not has_plausible_residual(fit))


def _nearest_cpa_range(fit: PassFit) -> float:
    """CPA range [m] of the nearest sensor."""
    return min(fit.closest_approach(position)[2]
               for position in fit.data.network.positions[fit.data.sensors])
