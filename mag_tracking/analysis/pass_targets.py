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
"""Maximum number of targets in a joint fit; each has a dozen unknowns."""

MAX_LENGTH = 18.75
"""[m] Maximum length of the iron of one vehicle: a road train (directive 96/53/EC)."""

MAX_VELOCITY_SPREAD = 0.25
"""Maximum relative difference of the velocities of parts of one vehicle."""


def fit_targets(data: PassData, alone: Sequence[PassFit], paths: FloatArray, ground: GroundPrior,
                orders: Sequence[int], stopped: Callable[[], bool] | None = None
                ) -> tuple[tuple[PassFit, ...], ...]:
    """Fit a pass as one target or as the tracked targets, whichever explains the field.

    The number of targets is not observable from the fit alone: a long row of dipoles can explain
    two vehicles in line, and two straight targets can explain one that turns.

    Parameters
    ----------
    data : PassData
    alone : sequence of PassFit
        Fits as a single target, with several numbers of dipoles.
    paths : (K, 6) array, m, m/s
        Positions of the tracked targets when `data.t` is zero, and their velocities.
    ground : GroundPrior
    orders : sequence of int
        Numbers of dipoles to try for several targets.
    stopped : function, optional
        Returns whether to abandon the fit. The result of an abandoned fit is not valid.

    Returns
    -------
    tuple of tuples of PassFit
        For each target, one fit per number of dipoles. The fits as a single target if that
        explains the field as well, or if the targets would be parts of it (long vehicles are
        sometimes tracked as two). The fits have a reason if neither one target nor the tracked
        targets explain the field.
    """
    n_targets = len(paths)
    if n_targets < 2 or len(data.sensors) < 2:
        return (tuple(alone),)
    if n_targets > MAX_TARGETS:
        return (_rejected(alone, n_targets, f'at most {MAX_TARGETS} can be fitted together'),)
    found = fit_joint(data, paths, ground, orders, stopped=stopped)
    if not found:
        return (_rejected(alone, n_targets,
                         'there are too few measurements to fit them together'),)
    best, one = [_best(fits) for fits in found], _best(alone)
    if not one.reason and one.length[0] <= MAX_LENGTH and all(fit.determined for fit in best) and (
            _are_parts(data, best) or order_criteria([one, best[0]])[0] == 0.0):
        return (tuple(alone),)
    why = _rejection_reason(data, best)
    return (_rejected(alone, n_targets, why),) if why else found


def _best(fits: Sequence[PassFit]) -> PassFit:
    """The fit that `choose_order` considers; the first one if none is determined."""
    return fits[int(np.argmin(order_criteria(fits)))]


def _are_parts(data: PassData, fits: Sequence[PassFit]) -> bool:
    """Whether targets move together and overlap."""
    velocity = np.array([fit.velocity for fit in fits])
    mean = velocity.mean(axis=0)
    return bool((np.linalg.norm(velocity - mean, axis=1)
                 <= MAX_VELOCITY_SPREAD * np.linalg.norm(mean)).all()
                and not are_separate(data, [path_from(data, fit) for fit in fits]))


def _rejection_reason(data: PassData, fits: Sequence[PassFit]) -> str:
    """Why a joint fit is rejected; empty if it is not. An error in one target affects all."""
    if not all(fit.converged for fit in fits):
        return 'but the joint fit did not converge'
    if not all(has_plausible_residual(fit) for fit in fits):
        return ('but constant velocities leave '
                f'{1.0 - fits[0].explained:.1%} of the field unexplained (a turn, braking, '
                'another vehicle)')
    if not are_separate(data, [path_from(data, fit) for fit in fits]):
        return 'but the fitted vehicles overlap (a turn, braking, another vehicle)'
    for k, fit in enumerate(fits, 1):
        if fit.reason:
            return f'vehicle {k}: {fit.reason}'
        if fit.length[0] > MAX_LENGTH:
            return f'vehicle {k}: a length of {fit.length[0]:.0f} m exceeds that of any vehicle'
    return ''


def _rejected(fits: Sequence[PassFit], n_targets: int, why: str) -> tuple[PassFit, ...]:
    """The same fits with a reason and without trusted quantities."""
    reason = f'not one target: {n_targets} were tracked, {why}'
    return tuple(replace(fit, reason=reason, trusted=()) for fit in fits)
