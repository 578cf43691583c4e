"""Batch fit of a pass: where something went by, how fast, how long it is, and its moments."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mag_tracking.analysis.pass_covariance import SensorErrors
from mag_tracking.analysis.pass_data import PassData, background_columns, separable_problem
from mag_tracking.analysis.pass_description import PATH_TOLERANCE, fits_at_minimum
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.inference.separable_fit import search
from mag_tracking.physics.passes import RowPass

N_COARSE = 24
"""Samples of each sensor that the starts are judged by."""

COARSE_ERROR = 0.1
"""The starts are judged as if the field were known to this share: that smooths the valleys."""

FALSE_ALARM = 1e-6
"""A field that noise exceeds with this probability is none."""

AS_BOUGHT = SensorErrors()
"""Errors of sensors that were bought and set up by hand."""


def fit_pass(data: PassData, n_dipoles: int = 3,
             cpa_range: tuple[float, float] | None = None,
             errors: SensorErrors = AS_BOUGHT) -> PassFit:
    """Fit a row of dipoles at constant velocity to what a network measured.

    Parameters
    ----------
    data : PassData
    n_dipoles : int
        The model order; 1 = a point target, without a length.
    cpa_range : (range, std) [m], optional
        For one sensor, which cannot tell the scale: the range at the closest point is known
        beforehand (TSP14 section IV.B).
    errors : SensorErrors
        Of the sensors, for the honest covariance.

    Returns
    -------
    PassFit
        With time zero at the strongest field. Its `reason` says why there is no answer.

    Raises ValueError for a `cpa_range` with several sensors.
    Source: TSP14 sections III.A and V; T10 Alg. 1.
    """
    if cpa_range is not None and len(data.sensors) > 1:
        raise ValueError(f'a known CPA range is for one sensor, there are {len(data.sensors)}')
    reason = unusable(data, (n_dipoles,))
    if reason:
        return PassFit(n_dipoles, data, reason)
    data, rough = at_strongest(data)
    model_of = partial(RowPass, n_dipoles=n_dipoles)
    problem = separable_problem(data, model_of)
    n_free = data.n_independent - background_columns(data, data.whitening).shape[1]
    limit = energy_threshold(FALSE_ALARM, n_free)
    if problem.energy <= limit:
        return PassFit(n_dipoles, data, 'out of range: the field is no stronger than noise '
                       f'(energy {problem.energy:.0f}, noise stays below {limit:.0f})')
    starts = starting_paths(rough, n_dipoles)
    found = search(separable_problem(rough, model_of, COARSE_ERROR),
                   separable_problem(rough, model_of), problem, starts,
                   PATH_TOLERANCE[:starts.shape[1]], shorter_rows if n_dipoles > 1 else None)
    if not np.isfinite(found.cost):
        return PassFit(n_dipoles, data, 'no start of the search could be used')
    theta, p = found.theta, problem.linear(found.theta)
    theta, p = model_of(data.t, data.positions, data.whitening).forward(theta, p)
    left = max(found.cost - n_free, 0.0) / (problem.energy - n_free)
    fit, = fits_at_minimum(data, (n_dipoles,), replace(found, theta=theta), p, 1.0 - left, errors,
                           cpa_range)
    return fit


def at_strongest(data: PassData) -> tuple[PassData, PassData]:
    """A pass with time zero at its strongest field, and a few means of it."""
    rough = data.averaged(N_COARSE)
    departure = rough.departure
    seconds = rough.t[np.argmax(np.einsum('ni,ni->n', departure, departure))]
    return data.shifted(seconds), rough.shifted(seconds)


def unusable(data: PassData, orders: Sequence[int]) -> str:
    """Why rows of `orders` dipoles cannot be fitted, before trying; or nothing."""
    if min(orders) < 1:
        raise ValueError(f'a row needs at least one dipole, got {min(orders)}')
    if not len(data.sensors):
        return 'no sensor has a measurement'
    axes = sum(int((~np.isnan(data.field[data.sensor == j])).any(axis=0).sum())
               for j in data.sensors)
    unknowns = sum(6 + (n > 1) + 3 * n for n in orders) + axes
    if data.n_values <= unknowns:
        return f'fewer measurements ({data.n_values}) than unknowns ({unknowns}) and one to spare'
    return ''


def starting_paths(data: PassData, n_dipoles: int) -> FloatArray:
    """Paths (n, 6 or 7) to search from: all headings, past the sensor with the strongest field.

    How long that sensor sees the target says how fast it is for its distance.
    """
    departure = data.departure
    energy = np.einsum('ni,ni->n', departure, departure)
    strongest = int(np.argmax(energy))
    mine = data.sensor == data.sensor[strongest]
    weight = energy[mine] / energy[mine].sum()
    t_cpa = weight @ data.t[mine]
    width = np.sqrt(weight @ np.square(data.t[mine] - t_cpa))
    heading, offset, ratio = (a.ravel() for a in np.meshgrid(
        np.arange(12) * np.pi / 6.0, (-8.0, -4.5, -2.0, 2.0, 4.5, 8.0),
        (0.25, 0.35, 0.5, 0.7, 1.0, 1.4), indexing='ij'))
    length = 3.0 if n_dipoles > 1 else 0.0
    along = np.stack([np.cos(heading), np.sin(heading), 0.0 * heading], axis=1)
    aside = np.stack([-np.sin(heading), np.cos(heading), 0.0 * heading], axis=1)
    reach = np.hypot(np.hypot(offset, 0.5), 0.35 * length)
    velocity = along * (ratio * reach / width)[:, None]
    position = (data.positions[strongest] + offset[:, None] * aside - t_cpa * velocity
                + [0.0, 0.0, 0.5])
    return np.hstack([position, velocity, np.full((len(heading), int(n_dipoles > 1)), length)])


def shorter_rows(path: FloatArray) -> FloatArray:
    """Paths (n, 7) of shorter rows that fit nearly as well as `path` (7,) does.

    A row with an empty end looks like a shorter one whose middle is elsewhere.
    """
    rows = []
    for share, ahead in ((0.7, 0.15), (0.7, 0.0), (0.7, -0.15), (0.4, 0.25), (0.4, 0.0),
                         (0.4, -0.25), (0.1, 0.0), (1.5, 0.0)):
        row = path.copy()
        row[:3] += ahead * path[6] * path[3:6] / np.linalg.norm(path[3:6])
        row[6] *= share
        rows.append(row)
    return np.array(rows)
