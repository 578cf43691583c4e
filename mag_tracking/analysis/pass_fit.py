"""Batch fit of a pass: where something went by, how fast, how long it is, and its moments."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from mag_tracking.analysis.bearing import bearing_of, scaled_to_range
from mag_tracking.analysis.pass_data import PassData, background_columns, separable_problem
from mag_tracking.analysis.pass_deviation import (
    SensorErrors,
    honest_covariance,
    velocity_change,
)
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import doubt, left_elsewhere, trusted
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.crlb import bound, cpa_information, information
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.inference.least_squares import Minimum, search
from mag_tracking.physics.passes import RowPass

N_COARSE = 24
"""Samples of each sensor that the starts are judged by."""

COARSE_ERROR = 0.1
"""The starts are judged as if the field were known to this share: that smooths the valleys."""

APART = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3])
"""[m], [m/s], [m] Paths that are closer than this are the same."""

FALSE_ALARM = 1e-6
"""A field that noise exceeds with this probability is none."""

AS_BOUGHT = SensorErrors()
"""Errors of sensors that were bought and set up by hand."""

EXACT = 1e-4
"""[m] Deviation of a CPA range that is only a unit of length."""


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
    reason = _unusable(data, n_dipoles)
    if reason:
        return PassFit(n_dipoles, data, reason)
    rough = data.averaged(N_COARSE)
    seconds = rough.t[_strongest(rough)]
    data, rough = data.shifted(seconds), rough.shifted(seconds)
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
                   APART[:starts.shape[1]], shorter_rows if n_dipoles > 1 else None)
    if not np.isfinite(found.cost):
        return PassFit(n_dipoles, data, 'no start of the search could be used')
    theta, p = found.theta.copy(), problem.linear(found.theta)
    if n_dipoles > 1 and theta[6] < 0.0:
        # The same row from its other end.
        theta[6] = -theta[6]
        T = RowPass(data.t, data.positions, data.whitening, n_dipoles).combinations
        p = T.T @ (T @ p).reshape(-1, 3)[::-1].ravel()
    left = max(found.cost - n_free, 0.0) / (problem.energy - n_free)
    return _described(data, n_dipoles, theta, p, found, 1.0 - left, cpa_range,
                      errors)


def _strongest(data: PassData) -> int:
    """Index of the sample with the strongest field beyond the background."""
    departure = data.departure
    return int(np.argmax(np.einsum('ni,ni->n', departure, departure)))


def _unusable(data: PassData, n_dipoles: int) -> str:
    """Why this cannot be fitted, before trying; or nothing."""
    if n_dipoles < 1:
        raise ValueError(f'a row needs at least one dipole, got {n_dipoles}')
    if not len(data.sensors):
        return 'no sensor has a measurement'
    axes = sum(int((~np.isnan(data.field[data.sensor == j])).any(axis=0).sum())
               for j in data.sensors)
    unknowns = 6 + (n_dipoles > 1) + 3 * n_dipoles + axes
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


def _described(data: PassData, n_dipoles: int, theta: FloatArray, p: FloatArray, found: Minimum,
               explained: float, cpa_range: tuple[float, float] | None,
               errors: SensorErrors) -> PassFit:
    """The `PassFit` of a minimum."""
    one = len(data.sensors) == 1
    if one:
        place = data.network.positions[data.sensors[0]]
        # Nothing measures the scale: the CPA range is what it is said to be, or the unit.
        scaled = scaled_to_range(theta, p, place, cpa_range[0] if cpa_range else 1.0)
        if scaled is None:
            return PassFit(n_dipoles, data, 'the path goes through the sensor (r0 parallel to v0): '
                           'there is no closest point to scale by')
        theta, p = scaled
    H, T, names, predicted, background = _linearised(data, n_dipoles, theta, p)
    W = data.whitening
    whitened = W @ H.reshape(len(W), 3, -1)
    left = np.einsum('nij,nj->ni', W, np.nan_to_num(data.field - predicted))
    J = information(whitened)
    if one:
        J[:6, :6] += cpa_information(theta[:3] - place, theta[3:6],
                                     cpa_range[1] if cpa_range else EXACT)[:6, :6]
    covariance = bound(J)
    x = T @ np.concatenate([theta, p, background])
    seen_s = _seen_s(data)
    change, change_std = velocity_change(data, whitened, left, theta[3:6], seen_s)
    target = (H[:, len(theta):len(theta) + len(p)] @ p).reshape(-1, 3)
    # An unobservable state has an infinite variance; what it is combined to has none.
    with np.errstate(invalid='ignore'):
        honest = honest_covariance(data, whitened, left, target, covariance, errors)
        spread = np.sqrt(np.einsum('yi,ij,yj->y', H, honest, H)).reshape(-1, 3)
        covariance, honest = (T @ P @ T.T for P in (covariance, honest))
    fit = PassFit(n_dipoles, data, '', found.converged, names, x, covariance, honest, found.cost,
                  explained, seen_s, change, change_std,
                  left_elsewhere(data, n_dipoles, theta, target, left), predicted=predicted,
                  predicted_std=spread)
    fit = replace(fit, rivals=_mirrored(theta, place) if one else _rivals(fit, found.rivals))
    if one and cpa_range is None:
        fit = replace(fit, bearing=bearing_of(fit, place))
    return replace(fit, reason=doubt(fit), trusted=trusted(fit))


def _mirrored(theta: FloatArray, place: FloatArray) -> tuple[tuple[float, FloatArray], ...]:
    """`PassFit.rivals` for one sensor: seen from the other end of space all looks the same."""
    return ((0.0, np.concatenate([2.0 * place - theta[:3], -theta[3:6], theta[6:]])),)


def _rivals(fit: PassFit, minima: Iterable[tuple[FloatArray, float]]) -> tuple[
        tuple[float, FloatArray], ...]:
    """`PassFit.rivals` of the other minima (path, cost); a row seen from its other end is none."""
    rivals, excess = [], max(1.0, fit.normalised_cost)
    for path, cost in minima:
        path = np.append(path[:6], np.abs(path[6:]))
        if (np.abs(path - fit.x[:len(path)]) > APART[:len(path)]).any():
            rivals.append(((cost - fit.cost) / excess, path))
    return tuple(rivals)


def _seen_s(data: PassData) -> float:
    """[s] in which nearly all of the target's energy came."""
    energy = np.square(np.linalg.norm(data.departure, axis=1))
    order = np.argsort(data.t)
    part = np.cumsum(energy[order]) / energy.sum()
    first, last = data.t[order][np.searchsorted(part, (0.02, 0.98))]
    return float(last - first)


def _linearised(data: PassData, n_dipoles: int, theta: FloatArray, p: FloatArray) -> tuple[
        FloatArray, FloatArray, tuple[str, ...], FloatArray, FloatArray]:
    """The fit about its minimum.

    Returns the derivatives (3 n, n_x) of the field in the sensors' frames by path, combinations
    of moments and backgrounds; T (n_x, n_x), which turns these into the unknowns; the unknowns'
    names; the predicted field (n, 3); the backgrounds (q,).
    """
    network = data.network
    model = RowPass(data.t, data.positions, network.R_sw[data.sensor], n_dipoles)
    measured = ~np.isnan(data.field)
    columns = background_columns(data, measured[:, :, None] * np.eye(3))
    of_target = model.basis(theta[None])[0] @ p
    W = data.whitening

    def whitened(A: FloatArray) -> FloatArray:
        return (W @ A.reshape(len(W), 3, -1)).reshape(len(A), -1)

    y = np.nan_to_num(data.field).ravel() - of_target
    background = np.asarray(np.linalg.lstsq(
        whitened(columns), whitened(y[:, None])[:, 0], rcond=None)[0], dtype=np.float64)
    names = model.names + model.moment_names + tuple(
        f'B {network.names[j]} {"xyz"[a]}' for j in data.sensors
        for a in np.flatnonzero(measured[data.sensor == j].any(axis=0)))
    H = np.hstack([model.derivative(theta[None], p[None])[0], model.basis(theta[None])[0],
                   columns])
    first = len(theta)
    T = np.eye(H.shape[1])
    T[first:first + len(p), first:first + len(p)] = model.combinations
    return H, T, names, (of_target + columns @ background).reshape(-1, 3), background

