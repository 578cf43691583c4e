"""Fit of a pass as one target or as several tracked targets."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mag_tracking.analysis.joint_fit import (
    GroundPrior,
    are_separate,
    fit_joint,
    path_from,
)
from mag_tracking.analysis.model_order import order_criteria
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import has_plausible_residual
from mag_tracking.arrays import FloatArray

MAX_TARGETS = 3
"""Maximum number of targets in a joint fit, each with about twelve unknowns."""

MAX_LENGTH = 18.75
"""[m] Maximum length of the iron of one vehicle: the limit for road trains (Directive 96/53/EC)."""

MAX_VELOCITY_SPREAD = 0.25
"""Maximum difference between the velocity of a part of a vehicle and the mean velocity of all
parts, relative to the mean."""


def fit_targets(data: PassData, single_fits: Sequence[PassFit], paths: FloatArray,
                ground: GroundPrior, orders: Sequence[int],
                stopped: Callable[[], bool] | None = None) -> tuple[tuple[PassFit, ...], ...]:
    """Select between a fit of a pass as one target and a joint fit of the tracked targets.

    A fit alone does not determine the number of targets: a long row of dipoles can explain two
    vehicles in a line, and two targets on straight paths can explain a single target that turns.
    `single_fits` are returned if one target explains the field equally well, or if the fitted
    targets are parts of one vehicle (long vehicles are sometimes tracked as two). They are returned
    with a reason if the joint fit is impossible or is rejected.

    Parameters
    ----------
    single_fits : fits as a single target, one for each number of dipoles
    paths : (K, 6), tracked positions at time zero of `data` and velocities, m and m/s
    orders : candidate numbers of dipoles of each target in a joint fit
    stopped : whether to abandon the fit, whose result is then not valid
    """
    n_targets = len(paths)
    if n_targets < 2 or len(data.sensors) < 2:
        return (tuple(single_fits),)
    if n_targets > MAX_TARGETS:
        return (_reject(single_fits, n_targets,
                        f'but at most {MAX_TARGETS} can be fitted together'),)
    joint_fits = fit_joint(data, paths, ground, orders, stopped=stopped)
    if not joint_fits:
        return (_reject(single_fits, n_targets,
                        'but there are too few measurements to fit them together'),)
    best_joint, best_single = [_best_fit(fits) for fits in joint_fits], _best_fit(single_fits)
    if not best_single.reason and best_single.length[0] <= MAX_LENGTH and all(
            fit.determined for fit in best_joint) and (
            _are_parts(data, best_joint) or order_criteria([best_single, best_joint[0]])[0] == 0.0):
        return (tuple(single_fits),)
    reason = _rejection_reason(data, best_joint)
    return (_reject(single_fits, n_targets, reason),) if reason else joint_fits


def _best_fit(fits: Sequence[PassFit]) -> PassFit:
    """Return the fit with the smallest BIC, or the first fit if none is determined."""
    return fits[int(np.argmin(order_criteria(fits)))]


def _are_parts(data: PassData, fits: Sequence[PassFit]) -> bool:
    """Whether targets are parts of one vehicle: they overlap at almost equal velocities."""
    velocity = np.array([fit.velocity for fit in fits])
    mean = velocity.mean(axis=0)
    return bool((np.linalg.norm(velocity - mean, axis=1)
                 <= MAX_VELOCITY_SPREAD * np.linalg.norm(mean)).all()
                and not are_separate(data, [path_from(data, fit) for fit in fits]))


def _rejection_reason(data: PassData, fits: Sequence[PassFit]) -> str:
    """Reason why a joint fit is rejected; empty if it is accepted."""
    if not all(fit.converged for fit in fits):
        return 'but the joint fit did not converge'
    if not all(has_plausible_residual(fit) for fit in fits):
        return ('but constant velocities leave '
                f'{1.0 - fits[0].explained:.1%} of the field unexplained; possible causes are a '
                'turn, braking or another vehicle')
    if not are_separate(data, [path_from(data, fit) for fit in fits]):
        return ('but the fitted vehicles overlap; possible causes are a turn, braking or another '
                'vehicle')
    for k, fit in enumerate(fits, 1):
        if fit.reason:
            return f'but the fit of vehicle {k} is rejected: {fit.reason}'
        if fit.length[0] > MAX_LENGTH:
            return f'but the fitted length of vehicle {k}, {fit.length[0]:.0f} m, is too long'
    return ''


def _reject(fits: Sequence[PassFit], n_targets: int, details: str) -> tuple[PassFit, ...]:
    """Return the fits with a reason for rejection and without trusted quantities."""
    reason = f'not one target: {n_targets} targets were tracked, {details}'
    return tuple(replace(fit, reason=reason, trusted=()) for fit in fits)
