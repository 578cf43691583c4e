"""Batch fit of a pass: path, speed, length and moments of the target."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mag_tracking.analysis.pass_data import PassData, background_columns, separable_problem
from mag_tracking.analysis.pass_description import PATH_TOLERANCE, SensorErrors, fits_at_minimum
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.inference.least_squares import search
from mag_tracking.physics.passes import RowPass

N_COARSE = 24
"""Number of averaged samples per sensor in the coarse search."""
COARSE_ERROR = 0.1
"""Assumed error relative to the field in the coarse search; it smooths the cost function."""
FALSE_ALARM_PROBABILITY = 1e-6
"""False alarm probability of the energy threshold of a pass."""
DEFAULT_ERRORS = SensorErrors()
"""Errors of uncalibrated sensors that were mounted by hand."""


def fit_pass(data: PassData, n_dipoles: int = 3,
             cpa_range: tuple[float, float] | None = None,
             errors: SensorErrors = DEFAULT_ERRORS) -> PassFit:
    """Fit the path and moments of a row of dipoles at constant velocity to a pass.

    A row of one dipole is a point target without a length. `cpa_range` is a known CPA range and its
    std [m], only for a single sensor, for which the scale is not observable (TSP14 section IV.B).
    Time zero is at the strongest field. `errors` are included in the robust covariance. TSP14
    sections III.A and V; T10 Alg. 1.
    """
    reason = unusable_reason(data, (n_dipoles,))
    if reason:
        return PassFit(n_dipoles, data, reason)
    data, averaged = centred_on_peak(data)
    create_model = partial(RowPass, n_dipoles=n_dipoles)
    problem = separable_problem(data, create_model)
    noise_dof = data.n_independent - background_columns(data, data.whitening).shape[1]
    threshold = energy_threshold(FALSE_ALARM_PROBABILITY, noise_dof)
    if problem.energy <= threshold:
        return PassFit(n_dipoles, data, 'out of range: the field is no stronger than noise '
                       f'(energy {problem.energy:.0f}, threshold {threshold:.0f})')
    starts = starting_paths(averaged, n_dipoles)
    minimum = search(separable_problem(averaged, create_model, COARSE_ERROR),
                     separable_problem(averaged, create_model), problem, starts,
                     PATH_TOLERANCE[:starts.shape[1]], shorter_rows if n_dipoles > 1 else None)
    if not np.isfinite(minimum.cost):
        return PassFit(n_dipoles, data, 'no valid start of the search')
    theta, p = create_model(data.t, data.positions, data.whitening).with_nonnegative_length(
        minimum.theta, problem.linear(minimum.theta))
    unexplained = max(minimum.cost - noise_dof, 0.0) / (problem.energy - noise_dof)
    fit, = fits_at_minimum(data, (n_dipoles,), replace(minimum, theta=theta), p, 1.0 - unexplained,
                           errors, cpa_range)
    return fit


def centred_on_peak(data: PassData) -> tuple[PassData, PassData]:
    """Shift time zero to the strongest field of all samples, and of `N_COARSE` means per sensor."""
    averaged = data.averaged(N_COARSE)
    return data.shifted(averaged.peak_s), averaged.shifted(averaged.peak_s)


def unusable_reason(data: PassData, orders: Sequence[int]) -> str:
    """Reason why there are too few measurements for a fit; empty if there are enough."""
    if not len(data.sensors):
        return 'no sensor has a measurement'
    axes = sum(int((~np.isnan(data.field[data.sensor == j])).any(axis=0).sum())
               for j in data.sensors)
    unknowns = sum(6 + (n > 1) + 3 * n for n in orders) + axes
    if data.n_values <= unknowns:
        return f'too few measurements ({data.n_values}) for {unknowns} unknowns'
    return ''


def starting_paths(data: PassData, n_dipoles: int) -> FloatArray:
    """Create starting paths (n, 6 or 7) with various headings, offsets and speeds past the sensor
    with the strongest field, whose duration determines speed over distance."""
    field_change = data.field_change
    energy = np.einsum('ni,ni->n', field_change, field_change)
    strongest = int(np.argmax(energy))
    sensor_mask = data.sensor == data.sensor[strongest]
    weight = energy[sensor_mask] / energy[sensor_mask].sum()
    t_cpa = weight @ data.t[sensor_mask]
    duration_std = np.sqrt(weight @ np.square(data.t[sensor_mask] - t_cpa))
    heading, offset, speed_factor = (a.ravel() for a in np.meshgrid(
        np.arange(12) * np.pi / 6.0, (-8.0, -4.5, -2.0, 2.0, 4.5, 8.0),
        (0.25, 0.35, 0.5, 0.7, 1.0, 1.4), indexing='ij'))
    length = 3.0 if n_dipoles > 1 else 0.0
    along = np.stack([np.cos(heading), np.sin(heading), 0.0 * heading], axis=1)
    across = np.stack([-np.sin(heading), np.cos(heading), 0.0 * heading], axis=1)
    distance = np.hypot(np.hypot(offset, 0.5), 0.35 * length)
    velocity = along * (speed_factor * distance / duration_std)[:, None]
    position = (data.positions[strongest] + offset[:, None] * across - t_cpa * velocity
                + [0.0, 0.0, 0.5])
    return np.hstack([position, velocity, np.full((len(heading), int(n_dipoles > 1)), length)])


def shorter_rows(path: FloatArray) -> FloatArray:
    """Create starting paths of a row (7,): shorter rows, which may fit as well, and longer ones."""
    ratio, offset = np.array(((0.7, 0.15), (0.7, 0.0), (0.7, -0.15), (0.4, 0.25), (0.4, 0.0),
                              (0.4, -0.25), (0.1, 0.0), (1.5, 0.0))).T
    rows = np.tile(path, (len(ratio), 1))
    rows[:, :3] += (offset * path[6])[:, None] * path[3:6] / np.linalg.norm(path[3:6])
    rows[:, 6] *= ratio
    return rows
