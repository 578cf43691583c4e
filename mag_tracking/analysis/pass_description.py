"""Results of a batch fit for each target: estimates, covariances, rivals, rejection reasons."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from mag_tracking.analysis.bearing import bearing_of, scaled_to_range
from mag_tracking.analysis.pass_covariance import (
    SensorErrors,
    robust_covariance,
    shape_covariance,
    velocity_change,
)
from mag_tracking.analysis.pass_data import PassData, background_columns
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import (
    FittedRow,
    rejection_reason,
    residual_elsewhere,
    trusted_quantities,
)
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.crlb import bound, cpa_information, information
from mag_tracking.inference.least_squares import Minimum
from mag_tracking.physics.passes import SuperposedPasses

PATH_TOLERANCE = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3])
"""Maximum difference between two paths that count as equal: position [m], velocity [m/s] and length
[m]."""

CPA_UNIT_STD = 1e-4
"""[m] Standard deviation of an assumed CPA range. Such a range only defines the unit of length."""


def fits_at_minimum(data: PassData, orders: Sequence[int], minimum: Minimum, p: FloatArray,
                    explained: float, errors: SensorErrors,
                    cpa_range: tuple[float, float] | None = None,
                    path_std: FloatArray | None = None) -> tuple[PassFit, ...]:
    """Create the `PassFit` of each target from the minimum of a fit.

    Parameters
    ----------
    data : readings of several sensors, or of one sensor and one target
    minimum : its parameters are the concatenated paths of the targets
    p : (k,), linear parameters of `SuperposedPasses`
    explained : fraction of the energy that all targets explain
    cpa_range : CPA range and its std; see `fit_pass`
    path_std : (n_theta,), prior stds of the paths; infinite without a prior
    """
    if len(data.sensors) == 1:
        return (_fit_of_one_sensor(data, orders[0], minimum, p, explained, cpa_range, errors),)
    linear = _LinearisedFit.about(data, orders, minimum.theta, p)
    J = information(linear.whitened)
    if path_std is not None:
        path_indices = np.concatenate([indices[:len(path)] for indices, path in zip(
            linear.target_indices, linear.theta, strict=True)])
        J[path_indices, path_indices] += 1.0 / np.square(path_std)
    fits = _partial_fits(linear, minimum, explained, errors, bound(J))
    ends = np.cumsum([len(path) for path in linear.theta])[:-1]
    rivals = [([paths[i] for i in assignment(linear.theta, paths)], cost)
              for paths, cost in ((np.split(theta, ends), cost) for theta, cost in minimum.rivals)]
    fits = [replace(fit, rivals=_select_rivals(fit, [(paths[k], cost) for paths, cost in rivals]))
            for k, fit in enumerate(fits)]
    return tuple(replace(fit, reason=rejection_reason(fit), trusted=trusted_quantities(fit))
                 for fit in fits)


def _fit_of_one_sensor(data: PassData, n_dipoles: int, minimum: Minimum, p: FloatArray,
                       explained: float, cpa_range: tuple[float, float] | None,
                       errors: SensorErrors) -> PassFit:
    """Create the `PassFit` of a single sensor, for which the scale is not observable."""
    position = data.network.positions[data.sensors[0]]
    # Without a known CPA range, the range is the unit of length.
    scaled = scaled_to_range(minimum.theta, p, position, cpa_range[0] if cpa_range else 1.0,
                             float(np.ptp(data.t)))
    if scaled is None:
        return PassFit(n_dipoles, data, 'the path passes through the sensor (r0 parallel to v0): '
                       'the CPA range is zero and does not define a scale')
    theta, p = scaled
    linear = _LinearisedFit.about(data, (n_dipoles,), theta, p)
    J = information(linear.whitened)
    J[:6, :6] += cpa_information(theta[:3] - position, theta[3:6],
                                 cpa_range[1] if cpa_range else CPA_UNIT_STD)[:6, :6]
    fit, = _partial_fits(linear, minimum, explained, errors, bound(J))
    # The path mirrored at the sensor has the same field.
    mirrored = np.concatenate([2.0 * position - theta[:3], -theta[3:6], theta[6:]])
    fit = replace(fit, rivals=((0.0, mirrored),))
    if cpa_range is None:
        fit = replace(fit, bearing=bearing_of(fit, position))
    return replace(fit, reason=rejection_reason(fit), trusted=trusted_quantities(fit))


@dataclass(frozen=True)
class _LinearisedFit:
    """Linearisation of a fit at its minimum: path and moments of each target, then the
    backgrounds."""

    data: PassData
    orders: tuple[int, ...]
    """Number of dipoles of each target."""
    theta: tuple[FloatArray, ...]
    """Path (6 or 7,) of each target."""
    whitened: FloatArray
    """(n, 3, n_x) whitened derivatives with respect to paths, moment combinations, backgrounds."""
    H: FloatArray
    """(3 n, n_x) the same derivatives, sensor frame, not whitened, [T] per unit of an unknown."""
    T: FloatArray
    """(n_x, n_x) transformation of the parameters of `H` into the unknowns `x`."""
    x: FloatArray
    """(n_x,) unknowns."""
    target_indices: tuple[IntArray, ...]
    """For each target, the indices of its unknowns, followed by the indices of the backgrounds."""
    names: tuple[str, ...]
    """Names of the unknowns."""
    fields: FloatArray
    """(K, n, 3) [T] field of each target, sensor frame."""
    background: FloatArray
    """(n, 3) [T] fitted background of each sample, sensor frame."""
    residuals: FloatArray
    """(n, 3) whitened residuals."""

    @classmethod
    def about(cls, data: PassData, orders: Sequence[int], theta: FloatArray,
              p: FloatArray) -> '_LinearisedFit':
        """Linearise a fit at the paths `theta` (n_theta,) and the linear parameters `p` (k,)."""
        model = SuperposedPasses.from_orders(orders, data.t, data.positions,
                                             data.network.R_sw[data.sensor])
        is_measured = ~np.isnan(data.field)
        columns = background_columns(data, is_measured[:, :, None] * np.eye(3))
        D, A, W = model.derivative(theta[None], p[None])[0], model.basis(theta[None])[0], \
            data.whitening
        fields = np.stack([(A[:, m] @ p[m]).reshape(-1, 3) for m in model.moment_slices])
        y = np.nan_to_num(data.field) - fields.sum(axis=0)
        backgrounds = np.asarray(np.linalg.lstsq(
            _flatten(W @ columns.reshape(*W.shape[:2], -1)), np.einsum('nij,nj->ni', W, y).ravel(),
            rcond=None)[0], dtype=np.float64)
        H = np.hstack([*(part for path, m in zip(model.path_slices, model.moment_slices,
                                                 strict=True)
                         for part in (D[:, path], A[:, m])), columns])
        T, names, target_indices, begin = np.eye(H.shape[1]), [], [], 0
        background_indices = np.arange(H.shape[1] - len(backgrounds), H.shape[1])
        for row in model.rows:
            end = begin + len(row.names) + 3 * row.n_dipoles
            T[begin + len(row.names):end, begin + len(row.names):end] = row.combinations
            target_indices.append(np.concatenate([np.arange(begin, end), background_indices]))
            names += [*row.names, *row.moment_names]
            begin = end
        names += [f'B {data.network.names[j]} {"xyz"[a]}' for j in data.sensors
                  for a in np.flatnonzero(is_measured[data.sensor == j].any(axis=0))]
        background = (columns @ backgrounds).reshape(-1, 3)
        residuals = np.nan_to_num(data.field - fields.sum(axis=0) - background)
        x = np.concatenate([*(part for path, m in zip(model.path_slices, model.moment_slices,
                                                      strict=True)
                              for part in (theta[path], p[m])), backgrounds])
        return cls(data, tuple(orders), tuple(model.split(theta)),
                   W @ H.reshape(len(W), 3, -1), H, T, T @ x, tuple(target_indices),
                   tuple(names), fields, background, np.einsum('nij,nj->ni', W, residuals))


def _flatten(A: FloatArray) -> FloatArray:
    """Reshape (n, 3, q) to (3 n, q)."""
    return A.reshape(-1, A.shape[-1])


def _partial_fits(linear: _LinearisedFit, minimum: Minimum, explained: float, errors: SensorErrors,
                  covariance: FloatArray) -> list[PassFit]:
    """Create the `PassFit` of each target without `rivals`, `reason` and `trusted`; `covariance` is
    that of the noise alone."""
    data, H, T = linear.data, linear.H, linear.T
    total_field = linear.fields.sum(axis=0)
    # The infinite variance of an unobservable state results in NaN.
    with np.errstate(invalid='ignore'):
        robust = robust_covariance(data, linear.whitened, linear.residuals, total_field, covariance,
                                   errors)
        shapes = [shape_covariance(data, linear.whitened, covariance, int(indices[0]), n, path)
                  for n, path, indices in zip(linear.orders, linear.theta, linear.target_indices,
                                              strict=True)]
        predicted_std = np.sqrt(np.einsum('yi,ij,yj->y', H, robust, H)).reshape(-1, 3)
        covariance, robust = (T @ P @ T.T for P in (covariance, robust))
    unexplained = residual_elsewhere(data, [FittedRow(n, path, field) for n, path, field in zip(
        linear.orders, linear.theta, linear.fields, strict=True)], linear.residuals)
    fits = []
    for k, (n_dipoles, indices) in enumerate(zip(linear.orders, linear.target_indices,
                                                 strict=True)):
        target_data = replace(data, field=data.field - (total_field - linear.fields[k]))
        duration_s = _duration_s(target_data)
        change = velocity_change(data, linear.whitened, linear.residuals, int(indices[0]),
                                 linear.theta[k][3:6], duration_s)
        block = np.ix_(indices, indices)
        fits.append(PassFit(
            n_dipoles, target_data, '', minimum.converged, tuple(linear.names[i] for i in indices),
            linear.x[indices], covariance[block], robust[block], minimum.cost, explained,
            duration_s, *change, unexplained, predicted=linear.fields[k] + linear.background,
            predicted_std=predicted_std, n_other_unknowns=len(linear.x) - len(indices),
            shape_covariance=shapes[k]))
    return fits


def assignment(paths: Sequence[FloatArray], others: Sequence[FloatArray]) -> tuple[int, ...]:
    """For each path, the index of its match in `others`, so that the total distance is minimal.

    The order of the targets in a solution of a joint fit is arbitrary.
    """
    distance = [[float(np.square((other[:6] - path[:6]) / PATH_TOLERANCE[:6]).sum())
                 for other in others] for path in paths]
    return min(permutations(range(len(paths))),
               key=lambda order: sum(distance[k][i] for k, i in enumerate(order)))


def _select_rivals(fit: PassFit, minima: Iterable[tuple[FloatArray, float]]) -> tuple[
        tuple[float, FloatArray], ...]:
    """Create `PassFit.rivals` from the minima (path, cost) that differ from the fit by more than
    the sign of the length."""
    rivals, cost_scale = [], max(1.0, fit.normalised_cost)
    for path, cost in minima:
        path = np.append(path[:6], np.abs(path[6:]))
        n = min(len(path), 6 + (fit.n_dipoles > 1))
        if (np.abs(path[:n] - fit.x[:n]) > PATH_TOLERANCE[:n]).any():
            rivals.append(((cost - fit.cost) / cost_scale, path))
    return tuple(rivals)


def _duration_s(data: PassData) -> float:
    """Duration [s] of the interval that contains the central 96 % of the target's energy."""
    energy = np.square(np.linalg.norm(data.field_change, axis=1))
    order = np.argsort(data.t)
    fraction = np.cumsum(energy[order]) / energy.sum()
    first, last = data.t[order][np.searchsorted(fraction, (0.02, 0.98))]
    return float(last - first)
