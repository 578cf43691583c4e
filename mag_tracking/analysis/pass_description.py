"""Results of a batch fit for each target: estimates, covariances, rivals, rejection reasons."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from mag_tracking.analysis import pass_trust
from mag_tracking.analysis.pass_data import PassData, background_columns
from mag_tracking.analysis.pass_result import PassFit, bearing_of, scaled_to_range
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import cross_matrix
from mag_tracking.inference.crlb import bound, cpa_information, information
from mag_tracking.inference.least_squares import Minimum, model_error_covariance
from mag_tracking.physics.passes import SuperposedPasses

MIDDLE_FRACTION, MIN_MIDDLE_STD, MIDDLE_ACROSS_STD = 0.15, 0.4, 0.1
"""Standard deviation of the distance from the centre of the row to the middle of the vehicle: along
the vehicle relative to the length of the row, and at least [m]; across it and vertically [m]. The
engine of a truck is at one end; the engine and the axles of a car are nearly symmetrical."""
PATH_TOLERANCE = np.array([0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3])
"""Maximum difference between equal paths: position [m], velocity [m/s] and length [m]."""
CPA_UNIT_STD = 1e-4
"""[m] Standard deviation of an assumed CPA range. Such a range only defines the unit of length."""


@dataclass(frozen=True)
class SensorErrors:
    """Sensor errors that cannot be estimated from one pass."""

    rotation_std: float = float(np.deg2rad(2.0))
    """[rad] about each axis, for sensors without `orientation_std` in the network; the default is
    for mounting by hand with a spirit level. For two sensors at a distance of 0.5 m, this error is
    equivalent to a delay of milliseconds."""
    gain_std: float = 0.01
    """Standard deviation of the gain of each axis; 1 to 3 % according to data sheets."""


def robust_covariance(data: PassData, whitened: FloatArray, residuals: FloatArray,
                      target: FloatArray, covariance: FloatArray,
                      errors: SensorErrors) -> FloatArray:
    """Covariance (n_x, n_x) due to noise (`covariance`), model error and sensor errors.

    `whitened` (n, 3, n_x) derivatives and `residuals` (n, 3) are of the field, `target` (n, 3) [T,
    sensor frame] is the field of the target.
    """
    model_error = model_error_covariance(*_split_by_sensor(data, whitened, residuals), covariance)
    sensor_error = np.zeros_like(covariance)
    R_sw = data.network.R_sw
    for j in data.sensors:
        sensor_mask = data.sensor == j
        configured_std = data.network.orientation_std[j]
        std = np.full(3, errors.rotation_std) if configured_std is None else configured_std
        rotation_covariance = R_sw[j] @ np.diag(np.square(std)) @ R_sw[j].T
        field = target[sensor_mask]
        G = np.concatenate([-cross_matrix(field), field[:, :, None] * np.eye(3)], axis=2)
        shift = covariance @ np.einsum('nax,nab->xb', whitened[sensor_mask],
                                       data.whitening[sensor_mask] @ G)
        P = np.zeros((6, 6))
        P[:3, :3], P[3:, 3:] = rotation_covariance, errors.gain_std**2 * np.eye(3)
        sensor_error += shift @ P @ shift.T
    return covariance + model_error + sensor_error


def shape_covariance(data: PassData, whitened: FloatArray, covariance: FloatArray,
                     position_index: int, row: pass_trust.FittedRow) -> FloatArray:
    """Covariance (3, 3) [m², world frame] of the middle of a vehicle about the centre of its row.

    The field of iron that extends by `reach` beyond the dipoles resembles that of dipoles at
    another distance; the relative difference is the square of reach over distance. Sensors on one
    side of a road measure a wrong range without a residual, whereas the errors of two sides cancel.
    `position_index` is the index of the unknown x in `whitened` (n, 3, n_x); y and z follow.
    """
    xyz, (n_dipoles, theta, _) = slice(position_index, position_index + 3), row
    length = abs(float(theta[6])) if n_dipoles > 1 else 0.0
    forward = theta[3:6] / np.linalg.norm(theta[3:6])
    offset = theta[:3] + data.t[:, None] * theta[3:6] - data.positions
    # The nearest point of the row.
    along = np.clip(offset @ forward, -0.5 * length, 0.5 * length)
    offset = offset - along[:, None] * forward
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    extent = pass_trust.reach(n_dipoles, length)
    apparent = extent**2 * offset / np.maximum(distance, extent)**2
    field_error = np.einsum('nai,ni->na', whitened[:, :, xyz], apparent)
    shift = covariance[xyz] @ np.einsum('nax,na->x', whitened, field_error)
    along_variance = max(MIN_MIDDLE_STD, MIDDLE_FRACTION * length)**2
    return np.outer(shift, shift) + MIDDLE_ACROSS_STD**2 * np.eye(3) \
        + (along_variance - MIDDLE_ACROSS_STD**2) * np.outer(forward, forward)


def _split_by_sensor(data: PassData, whitened: FloatArray, residuals: FloatArray) -> tuple[
        list[FloatArray], list[FloatArray], list[FloatArray]]:
    """Split times, derivatives and residuals by sensor."""
    rows = [data.sensor == j for j in data.sensors]
    return [data.t[r] for r in rows], [whitened[r] for r in rows], [residuals[r] for r in rows]


def velocity_change(data: PassData, whitened: FloatArray, residuals: FloatArray, x_index: int,
                    velocity: FloatArray, duration_s: float) -> tuple[float, float]:
    """Relative change of the velocity during `duration_s`, and its std including model error.

    A constant horizontal acceleration is estimated by one Gauss-Newton step from the minimum.
    `x_index` is the index of the unknown x in `whitened` (n, 3, n_x); y follows.
    """
    by_acceleration = 0.5 * np.square(data.t)[:, None, None] * whitened[:, :, x_index:x_index + 2]
    extended = np.concatenate([whitened, by_acceleration], axis=2)
    flat = extended.reshape(residuals.size, -1)
    norm = np.linalg.norm(flat, axis=0)
    # A column of zeros cannot be normalised.
    norm[norm == 0.0] = 1.0
    inverse = np.linalg.pinv(flat / norm, rcond=1e-8) / norm[:, None]
    step, covariance = inverse @ residuals.ravel(), inverse @ inverse.T
    new_residuals = (residuals.ravel() - flat @ step).reshape(residuals.shape)
    robust = covariance + model_error_covariance(*_split_by_sensor(data, extended, new_residuals),
                                                 covariance)
    scale = duration_s / np.linalg.norm(velocity)
    return (float(np.linalg.norm(step[-2:]) * scale),
            float(np.sqrt(np.trace(robust[-2:, -2:])) * scale))


def fits_at_minimum(data: PassData, orders: Sequence[int], minimum: Minimum, p: FloatArray,
                    explained: float, errors: SensorErrors,
                    cpa_range: tuple[float, float] | None = None,
                    path_std: FloatArray | None = None) -> tuple[PassFit, ...]:
    """Create the `PassFit` of each target from the minimum of a fit.

    The parameters of `minimum` are the concatenated paths of the targets, `p` (k,) the linear
    parameters of `SuperposedPasses`, `explained` the fraction of the energy that all targets
    explain, and `path_std` (n_theta,) the prior stds of the paths, infinite without a prior. The
    data of one sensor has one target and may have a `cpa_range`; see `fit_pass`.
    """
    if len(data.sensors) == 1:
        return (_fit_of_one_sensor(data, orders[0], minimum, p, explained, cpa_range, errors),)
    linear = _LinearisedFit(data, orders, minimum.theta, p)
    J = information(linear.whitened)
    if path_std is not None:
        path_indices = np.concatenate([indices[:len(row.theta)] for indices, row in zip(
            linear.target_indices, linear.rows, strict=True)])
        J[path_indices, path_indices] += 1.0 / np.square(path_std)
    fits = _partial_fits(linear, minimum, explained, errors, bound(J))
    fitted_paths, rivals = [row.theta for row in linear.rows], []
    for theta, cost in minimum.rivals:
        paths = np.split(theta, np.cumsum([len(path) for path in fitted_paths])[:-1])
        rivals.append(([paths[i] for i in assignment(fitted_paths, paths)], cost))
    fits = [replace(fit, rivals=_select_rivals(fit, [(paths[k], cost) for paths, cost in rivals]))
            for k, fit in enumerate(fits)]
    return tuple(map(_judged, fits))


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
    linear = _LinearisedFit(data, (n_dipoles,), theta, p)
    J = information(linear.whitened)
    J[:6, :6] += cpa_information(theta[:3] - position, theta[3:6],
                                 cpa_range[1] if cpa_range else CPA_UNIT_STD)[:6, :6]
    fit, = _partial_fits(linear, minimum, explained, errors, bound(J))
    # The path mirrored at the sensor has the same field.
    mirrored = np.concatenate([2.0 * position - theta[:3], -theta[3:6], theta[6:]])
    fit = replace(fit, rivals=((0.0, mirrored),))
    if cpa_range is None:
        fit = replace(fit, bearing=bearing_of(fit, position))
    return _judged(fit)


def _judged(fit: PassFit) -> PassFit:
    """Add the reason for a rejection and the trusted quantities to a fit."""
    return replace(fit, reason=pass_trust.rejection_reason(fit),
                   trusted=pass_trust.trusted_quantities(fit))


class _LinearisedFit:
    """Linearisation of a fit at its minimum: path and moments of each target, then the
    backgrounds.

    Attributes
    ----------
    rows : number of dipoles, path and field of each target
    H : (3 n, n_x) derivatives by paths, moments and backgrounds, sensor frame, [T] per unit
    T : (n_x, n_x) transformation of the parameters of `H` into the unknowns `x`
    x, names : (n_x,) values and names of the unknowns
    whitened : (n, 3, n_x) whitened derivatives `H`
    target_indices : for each target, the indices of its unknowns and of the backgrounds
    background : (n, 3) [T] fitted background of each sample, sensor frame
    residuals : (n, 3) whitened residuals
    """

    def __init__(self, data: PassData, orders: Sequence[int], theta: FloatArray,
                 p: FloatArray) -> None:
        model = SuperposedPasses.from_orders(orders, data.t, data.positions,
                                             data.network.R_sw[data.sensor])
        slices = list(zip(model.path_slices, model.moment_slices, strict=True))
        is_measured = ~np.isnan(data.field)
        columns = background_columns(data, is_measured[:, :, None] * np.eye(3))
        D, A, W = model.derivative(theta[None], p[None])[0], model.basis(theta[None])[0], \
            data.whitening
        fields = np.stack([(A[:, m] @ p[m]).reshape(-1, 3) for _, m in slices])
        self.data, self.rows = data, [pass_trust.FittedRow(*row) for row in zip(
            orders, model.split(theta), fields, strict=True)]
        y = np.nan_to_num(data.field) - fields.sum(axis=0)
        backgrounds = np.asarray(np.linalg.lstsq(
            (W @ columns.reshape(*W.shape[:2], -1)).reshape(columns.shape),
            np.einsum('nij,nj->ni', W, y).ravel(), rcond=None)[0], dtype=np.float64)
        self.background: FloatArray = (columns @ backgrounds).reshape(-1, 3)
        self.residuals: FloatArray = np.einsum('nij,nj->ni', W, np.nan_to_num(
            data.field - fields.sum(axis=0) - self.background))
        H = np.hstack([*(part for path, m in slices for part in (D[:, path], A[:, m])), columns])
        self.H, self.T, self.whitened = H, np.eye(H.shape[1]), W @ H.reshape(len(W), 3, -1)
        self.names, self.target_indices, begin = list[str](), list[IntArray](), 0
        background_indices = np.arange(H.shape[1] - len(backgrounds), H.shape[1])
        for row in model.rows:
            first, end = begin + len(row.names), begin + len(row.names) + 3 * row.n_dipoles
            self.T[first:end, first:end] = row.combinations
            self.target_indices.append(np.append(np.arange(begin, end), background_indices))
            self.names += [*row.names, *row.moment_names]
            begin = end
        self.names += [f'B {data.network.names[j]} {"xyz"[a]}' for j in data.sensors
                       for a in np.flatnonzero(is_measured[data.sensor == j].any(axis=0))]
        self.x: FloatArray = self.T @ np.concatenate([
            *(part for path, m in slices for part in (theta[path], p[m])), backgrounds])


def _partial_fits(linear: _LinearisedFit, minimum: Minimum, explained: float, errors: SensorErrors,
                  covariance: FloatArray) -> list[PassFit]:
    """Create the `PassFit` of each target without `rivals`, `reason` and `trusted`; `covariance` is
    that of the noise alone."""
    data, rows, H, T = linear.data, linear.rows, linear.H, linear.T
    total_field: FloatArray = np.sum([row.field for row in rows], axis=0)
    targets = list(zip(rows, linear.target_indices, strict=True))
    # The infinite variance of an unobservable state results in NaN.
    with np.errstate(invalid='ignore'):
        robust = robust_covariance(data, linear.whitened, linear.residuals, total_field, covariance,
                                   errors)
        shapes = [shape_covariance(data, linear.whitened, covariance, int(indices[0]), row)
                  for row, indices in targets]
        predicted_std = np.sqrt(np.einsum('yi,ij,yj->y', H, robust, H)).reshape(-1, 3)
        covariance, robust = (T @ P @ T.T for P in (covariance, robust))
    unexplained = pass_trust.residual_elsewhere(data, rows, linear.residuals)
    fits = []
    for (row, indices), shape in zip(targets, shapes, strict=True):
        target_data = replace(data, field=data.field - (total_field - row.field))
        duration_s = _duration_s(target_data)
        change = velocity_change(data, linear.whitened, linear.residuals, int(indices[0]),
                                 row.theta[3:6], duration_s)
        block = np.ix_(indices, indices)
        fits.append(PassFit(
            row.n_dipoles, target_data, '', minimum.converged,
            tuple(linear.names[i] for i in indices), linear.x[indices], covariance[block],
            robust[block], minimum.cost, explained, duration_s, *change, unexplained,
            predicted=row.field + linear.background, predicted_std=predicted_std,
            n_other_unknowns=len(linear.x) - len(indices), shape_covariance=shape))
    return fits


def assignment(paths: Sequence[FloatArray], others: Sequence[FloatArray]) -> tuple[int, ...]:
    """For each path, the index of its match in `others`, so that the total distance is minimal."""
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
