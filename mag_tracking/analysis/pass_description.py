"""Unknowns, covariances, rivals and doubts of each target at the minimum of a batch fit."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from mag_tracking.analysis.bearing import bearing_of, scaled_to_range
from mag_tracking.analysis.pass_data import PassData, background_columns
from mag_tracking.analysis.pass_deviation import (
    SensorErrors,
    robust_covariance,
    velocity_change,
)
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import FittedRow, doubt, residual_elsewhere, trusted
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.crlb import bound, cpa_information, information
from mag_tracking.inference.separable_fit import Minimum
from mag_tracking.physics.passes import SuperposedPasses

APART = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3])
"""[m], [m/s], [m] Paths that are closer than this are the same."""

EXACT = 1e-4
"""[m] Deviation of a CPA range that is only a unit of length."""


def fits_at_minimum(data: PassData, orders: Sequence[int], found: Minimum, p: FloatArray,
                    explained: float, errors: SensorErrors,
                    cpa_range: tuple[float, float] | None = None,
                    path_std: FloatArray | None = None) -> tuple[PassFit, ...]:
    """The `PassFit` of each of the targets that were fitted together.

    Parameters
    ----------
    data : PassData
        With several sensors, or of one target.
    orders : K int
        Dipoles of each target.
    found : Minimum
        The paths of the targets, one after the other.
    p : (k,)
        Linear parameters of `SuperposedPasses`.
    explained : float
        Share of the energy that all of them explain.
    errors : SensorErrors
    cpa_range : (range, std) [m], optional
        See `fit_pass`.
    path_std : (n_theta,), optional
        Deviations of what was known of the paths beforehand; infinite = nothing.
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
    return tuple(replace(fit, reason=doubt(fit), trusted=trusted(fit)) for fit in fits)


def _of_one_sensor(data: PassData, n_dipoles: int, found: Minimum, p: FloatArray,
                   explained: float, cpa_range: tuple[float, float] | None,
                   errors: SensorErrors) -> PassFit:
    """The `PassFit` of one sensor, which does not measure the scale."""
    place = data.network.positions[data.sensors[0]]
    # The CPA range is what it is said to be, or the unit.
    scaled = scaled_to_range(found.theta, p, place, cpa_range[0] if cpa_range else 1.0)
    if scaled is None:
        return PassFit(n_dipoles, data, 'the path goes through the sensor (r0 parallel to v0): '
                       'there is no closest point to scale by')
    theta, p = scaled
    about = _Linearised.about(data, (n_dipoles,), theta, p)
    J = information(about.whitened)
    J[:6, :6] += cpa_information(theta[:3] - place, theta[3:6],
                                 cpa_range[1] if cpa_range else EXACT)[:6, :6]
    fit, = _fits(about, found, explained, errors, bound(J))
    # Seen from the other end of space all looks the same.
    mirrored = np.concatenate([2.0 * place - theta[:3], -theta[3:6], theta[6:]])
    fit = replace(fit, rivals=((0.0, mirrored),))
    if cpa_range is None:
        fit = replace(fit, bearing=bearing_of(fit, place))
    return replace(fit, reason=doubt(fit), trusted=trusted(fit))


@dataclass(frozen=True)
class _Linearised:
    """A fit about its minimum. Unknowns: of each target path and moments, then the backgrounds."""

    data: PassData
    orders: tuple[int, ...]
    theta: tuple[FloatArray, ...]
    """Path (6 or 7,) of each target."""
    whitened: FloatArray
    """(n, 3, n_x) derivatives by paths, combinations of moments and backgrounds."""
    H: FloatArray
    """(3 n, n_x) the same [T], not whitened, in the sensors' frames."""
    T: FloatArray
    """(n_x, n_x) turns these into the unknowns."""
    x: FloatArray
    """(n_x,) the unknowns."""
    own: tuple[IntArray, ...]
    """Indices of the unknowns of each target, followed by the backgrounds."""
    names: tuple[str, ...]
    fields: FloatArray
    """(K, n, 3) [T] of each target, sensor frame."""
    background: FloatArray
    """(n, 3) [T]"""
    left: FloatArray
    """(n, 3) whitened residuals."""

    @classmethod
    def about(cls, data: PassData, orders: Sequence[int], theta: FloatArray,
              p: FloatArray) -> '_Linearised':
        """The fit about paths `theta` (n_theta,) and linear parameters `p` (k,)."""
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
        left = np.nan_to_num(data.field - fields.sum(axis=0) - background)
        x = np.concatenate([*(part for path, m in zip(model.paths, model.moments, strict=True)
                              for part in (theta[path], p[m])), level])
        return cls(data, tuple(orders), tuple(model.split(theta)),
                   W @ H.reshape(len(W), 3, -1), H, T, T @ x, tuple(own), tuple(names), fields,
                   background, np.einsum('nij,nj->ni', W, left))


def _flat(A: FloatArray) -> FloatArray:
    """(n, 3, q) as (3 n, q)."""
    return A.reshape(-1, A.shape[-1])


def _fits(about: _Linearised, found: Minimum, explained: float, errors: SensorErrors,
          covariance: FloatArray) -> list[PassFit]:
    """A `PassFit` of each target, without rivals and doubts; `covariance` (n_x, n_x) by noise."""
    data, H, T = about.data, about.H, about.T
    everything = about.fields.sum(axis=0)
    # An unobservable state has an infinite variance; what it is combined to has none.
    with np.errstate(invalid='ignore'):
        honest = robust_covariance(data, about.whitened, about.left, everything, covariance,
                                   errors)
        spread = np.sqrt(np.einsum('yi,ij,yj->y', H, honest, H)).reshape(-1, 3)
        covariance, honest = (T @ P @ T.T for P in (covariance, honest))
    elsewhere = residual_elsewhere(data, [FittedRow(n, path, field) for n, path, field in zip(
        about.orders, about.theta, about.fields, strict=True)], about.left)
    fits = []
    for k, (n_dipoles, own) in enumerate(zip(about.orders, about.own, strict=True)):
        alone = replace(data, field=data.field - (everything - about.fields[k]))
        seen_s = _seen_s(alone)
        change = velocity_change(data, about.whitened, about.left, int(own[0]),
                                 about.theta[k][3:6], seen_s)
        block = np.ix_(own, own)
        fits.append(PassFit(
            n_dipoles, alone, '', found.converged, tuple(about.names[i] for i in own),
            about.x[own], covariance[block], honest[block], found.cost, explained, seen_s,
            *change, elsewhere, predicted=about.fields[k] + about.background,
            predicted_std=spread, n_others=len(about.x) - len(own)))
    return fits


def assignment(paths: Sequence[FloatArray], others: Sequence[FloatArray]) -> tuple[int, ...]:
    """Index into `others` for each of K `paths` (6 or 7,) that minimises the total distance.

    The order of several targets in a solution is arbitrary.
    """
    away = [[float(np.square((other[:6] - path[:6]) / APART[:6]).sum()) for other in others]
            for path in paths]
    return min(permutations(range(len(paths))),
               key=lambda order: sum(away[k][i] for k, i in enumerate(order)))


def _rivals(fit: PassFit, minima: Iterable[tuple[FloatArray, float]]) -> tuple[
        tuple[float, FloatArray], ...]:
    """`PassFit.rivals` of other minima (path, cost), without the same row from its other end."""
    rivals, excess = [], max(1.0, fit.normalised_cost)
    for path, cost in minima:
        path = np.append(path[:6], np.abs(path[6:]))
        n = min(len(path), 6 + (fit.n_dipoles > 1))
        if (np.abs(path[:n] - fit.x[:n]) > APART[:n]).any():
            rivals.append(((cost - fit.cost) / excess, path))
    return tuple(rivals)


def _seen_s(data: PassData) -> float:
    """[s] in which nearly all of the target's energy came."""
    energy = np.square(np.linalg.norm(data.departure, axis=1))
    order = np.argsort(data.t)
    part = np.cumsum(energy[order]) / energy.sum()
    first, last = data.t[order][np.searchsorted(part, (0.02, 0.98))]
    return float(last - first)
