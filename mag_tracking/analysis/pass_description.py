"""Unknowns, covariances, rivals and rejection reasons of each target at the minimum of a batch
fit."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from mag_tracking.analysis.bearing import bearing_of, scaled_to_range
from mag_tracking.analysis.pass_covariance import (
    SensorErrors,
    robust_covariance,
    velocity_change,
)
from mag_tracking.analysis.pass_data import PassData, background_columns
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import (
    FittedRow,
    rejection_reason,
    residual_elsewhere,
    trusted,
)
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.crlb import bound, cpa_information, information
from mag_tracking.inference.separable_fit import Minimum
from mag_tracking.physics.passes import SuperposedPasses

PATH_TOLERANCE = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3])
"""[m], [m/s], [m] Paths that differ by less than this are the same."""

CPA_UNIT_STD = 1e-4
"""[m] Standard deviation of a CPA range that only serves as the unit of length."""


def fits_at_minimum(data: PassData, orders: Sequence[int], found: Minimum, p: FloatArray,
                    explained: float, errors: SensorErrors,
                    cpa_range: tuple[float, float] | None = None,
                    path_std: FloatArray | None = None) -> tuple[PassFit, ...]:
    """Describe the minimum of a joint fit by one `PassFit` for each target.

    Parameters
    ----------
    data : PassData
        Of several sensors, or of one target.
    orders : sequence of K int
        Number of dipoles of each target.
    found : Minimum
        Concatenated paths of the targets.
    p : (k,) array
        Linear parameters of `SuperposedPasses`.
    explained : float
        Share of the energy that all targets explain.
    errors : SensorErrors
    cpa_range : (float, float), m, optional
        Range at the CPA and its standard deviation; see `fit_pass`.
    path_std : (n_theta,) array, optional
        Prior standard deviations of the paths; infinite = no prior.

    Returns
    -------
    tuple of PassFit
    """
    if len(data.sensors) == 1:
        return (_of_one_sensor(data, orders[0], found, p, explained, cpa_range, errors),)
    about = _Linearised.about(data, orders, found.theta, p)
    J = information(about.whitened)
    if path_std is not None:
        of_paths = np.concatenate([own[:len(path)] for own, path in zip(
            about.own, about.theta, strict=True)])
        J[of_paths, of_paths] += 1.0 / np.square(path_std)
    fits = _fits(about, found, explained, errors, bound(J))
    ends = np.cumsum([len(path) for path in about.theta])[:-1]
    rivals = [([paths[i] for i in assignment(about.theta, paths)], cost)
              for paths, cost in ((np.split(theta, ends), cost) for theta, cost in found.rivals)]
    fits = [replace(fit, rivals=_rivals(fit, [(paths[k], cost) for paths, cost in rivals]))
            for k, fit in enumerate(fits)]
    return tuple(replace(fit, reason=rejection_reason(fit), trusted=trusted(fit)) for fit in fits)


def _of_one_sensor(data: PassData, n_dipoles: int, found: Minimum, p: FloatArray,
                   explained: float, cpa_range: tuple[float, float] | None,
                   errors: SensorErrors) -> PassFit:
    """`PassFit` of one sensor, for which the scale is not observable."""
    place = data.network.positions[data.sensors[0]]
    # The CPA range is the given one, or the unit of length.
    scaled = scaled_to_range(found.theta, p, place, cpa_range[0] if cpa_range else 1.0)
    if scaled is None:
        return PassFit(n_dipoles, data, 'the path goes through the sensor (r0 parallel to v0): '
                       'the CPA range is zero and gives no scale')
    theta, p = scaled
    about = _Linearised.about(data, (n_dipoles,), theta, p)
    J = information(about.whitened)
    J[:6, :6] += cpa_information(theta[:3] - place, theta[3:6],
                                 cpa_range[1] if cpa_range else CPA_UNIT_STD)[:6, :6]
    fit, = _fits(about, found, explained, errors, bound(J))
    # The path mirrored at the sensor gives the same field.
    mirrored = np.concatenate([2.0 * place - theta[:3], -theta[3:6], theta[6:]])
    fit = replace(fit, rivals=((0.0, mirrored),))
    if cpa_range is None:
        fit = replace(fit, bearing=bearing_of(fit, place))
    return replace(fit, reason=rejection_reason(fit), trusted=trusted(fit))


@dataclass(frozen=True)
class _Linearised:
    """A fit linearised at its minimum.

    Unknowns: path and moments of each target, then the backgrounds.
    """

    data: PassData
    orders: tuple[int, ...]
    theta: tuple[FloatArray, ...]
    """Path (6 or 7,) of each target."""
    whitened: FloatArray
    """(n, 3, n_x) whitened derivatives by paths, combinations of moments and backgrounds."""
    H: FloatArray
    """(3 n, n_x) the same in [T], not whitened, in the sensors' frames."""
    T: FloatArray
    """(n_x, n_x) transforms these parameters into the unknowns."""
    x: FloatArray
    """(n_x,) unknowns."""
    own: tuple[IntArray, ...]
    """Indices of the unknowns of each target, followed by those of the backgrounds."""
    names: tuple[str, ...]
    fields: FloatArray
    """(K, n, 3) [T] field of each target, sensor frame."""
    background: FloatArray
    """(n, 3) [T]"""
    residuals: FloatArray
    """(n, 3) whitened residuals."""

    @classmethod
    def about(cls, data: PassData, orders: Sequence[int], theta: FloatArray,
              p: FloatArray) -> '_Linearised':
        """Linearise at paths `theta` (n_theta,) and linear parameters `p` (k,)."""
        model = SuperposedPasses.of(orders, data.t, data.positions,
                                    data.network.R_sw[data.sensor])
        measured = ~np.isnan(data.field)
        columns = background_columns(data, measured[:, :, None] * np.eye(3))
        D, A, W = model.derivative(theta[None], p[None])[0], model.basis(theta[None])[0], \
            data.whitening
        fields = np.stack([(A[:, m] @ p[m]).reshape(-1, 3) for m in model.moments])
        y = np.nan_to_num(data.field) - fields.sum(axis=0)
        level = np.asarray(np.linalg.lstsq(
            _flat(W @ columns.reshape(*W.shape[:2], -1)), np.einsum('nij,nj->ni', W, y).ravel(),
            rcond=None)[0], dtype=np.float64)
        H = np.hstack([*(part for path, m in zip(model.paths, model.moments, strict=True)
                         for part in (D[:, path], A[:, m])), columns])
        T, names, own, first = np.eye(H.shape[1]), [], [], 0
        shared = np.arange(H.shape[1] - len(level), H.shape[1])
        for row in model.rows:
            end = first + len(row.names) + 3 * row.n_dipoles
            T[first + len(row.names):end, first + len(row.names):end] = row.combinations
            own.append(np.concatenate([np.arange(first, end), shared]))
            names += [*row.names, *row.moment_names]
            first = end
        names += [f'B {data.network.names[j]} {"xyz"[a]}' for j in data.sensors
                  for a in np.flatnonzero(measured[data.sensor == j].any(axis=0))]
        background = (columns @ level).reshape(-1, 3)
        residuals = np.nan_to_num(data.field - fields.sum(axis=0) - background)
        x = np.concatenate([*(part for path, m in zip(model.paths, model.moments, strict=True)
                              for part in (theta[path], p[m])), level])
        return cls(data, tuple(orders), tuple(model.split(theta)),
                   W @ H.reshape(len(W), 3, -1), H, T, T @ x, tuple(own), tuple(names), fields,
                   background, np.einsum('nij,nj->ni', W, residuals))


def _flat(A: FloatArray) -> FloatArray:
    """(n, 3, q) as (3 n, q)."""
    return A.reshape(-1, A.shape[-1])


def _fits(about: _Linearised, found: Minimum, explained: float, errors: SensorErrors,
          covariance: FloatArray) -> list[PassFit]:
    """`PassFit` of each target, without rivals and reasons; `covariance` is due to noise."""
    data, H, T = about.data, about.H, about.T
    everything = about.fields.sum(axis=0)
    # An unobservable state has an infinite variance; combinations of it are NaN.
    with np.errstate(invalid='ignore'):
        robust = robust_covariance(data, about.whitened, about.residuals, everything, covariance,
                                   errors)
        spread = np.sqrt(np.einsum('yi,ij,yj->y', H, robust, H)).reshape(-1, 3)
        covariance, robust = (T @ P @ T.T for P in (covariance, robust))
    elsewhere = residual_elsewhere(data, [FittedRow(n, path, field) for n, path, field in zip(
        about.orders, about.theta, about.fields, strict=True)], about.residuals)
    fits = []
    for k, (n_dipoles, own) in enumerate(zip(about.orders, about.own, strict=True)):
        alone = replace(data, field=data.field - (everything - about.fields[k]))
        duration_s = _duration_s(alone)
        change = velocity_change(data, about.whitened, about.residuals, int(own[0]),
                                 about.theta[k][3:6], duration_s)
        block = np.ix_(own, own)
        fits.append(PassFit(
            n_dipoles, alone, '', found.converged, tuple(about.names[i] for i in own),
            about.x[own], covariance[block], robust[block], found.cost, explained, duration_s,
            *change, elsewhere, predicted=about.fields[k] + about.background,
            predicted_std=spread, n_other_unknowns=len(about.x) - len(own)))
    return fits


def assignment(paths: Sequence[FloatArray], others: Sequence[FloatArray]) -> tuple[int, ...]:
    """Match two sets of paths so that their total distance is minimal.

    The order of several targets in a solution is arbitrary.

    Parameters
    ----------
    paths, others : sequence of K (6 or 7,) array, m, m/s, m

    Returns
    -------
    tuple of int
        Index into `others` for each of `paths`.
    """
    away = [[float(np.square((other[:6] - path[:6]) / PATH_TOLERANCE[:6]).sum())
             for other in others] for path in paths]
    return min(permutations(range(len(paths))),
               key=lambda order: sum(away[k][i] for k, i in enumerate(order)))


def _rivals(fit: PassFit, minima: Iterable[tuple[FloatArray, float]]) -> tuple[
        tuple[float, FloatArray], ...]:
    """`PassFit.rivals` from other minima (path, cost), except for the same row reversed."""
    rivals, excess = [], max(1.0, fit.normalised_cost)
    for path, cost in minima:
        path = np.append(path[:6], np.abs(path[6:]))
        n = min(len(path), 6 + (fit.n_dipoles > 1))
        if (np.abs(path[:n] - fit.x[:n]) > PATH_TOLERANCE[:n]).any():
            rivals.append(((cost - fit.cost) / excess, path))
    return tuple(rivals)


def _duration_s(data: PassData) -> float:
    """Duration [s] that contains nearly all of the target's energy."""
    energy = np.square(np.linalg.norm(data.departure, axis=1))
    order = np.argsort(data.t)
    part = np.cumsum(energy[order]) / energy.sum()
    first, last = data.t[order][np.searchsorted(part, (0.02, 0.98))]
    return float(last - first)
