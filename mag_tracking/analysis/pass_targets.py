"""Fit a pass as one target, or as several where several were tracked."""

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
from mag_tracking.analysis.pass_trust import describes
from mag_tracking.arrays import FloatArray

MAX_TARGETS = 3
"""More are not fitted together: each has a dozen unknowns."""

LONGEST = 18.75
"""[m] The iron of one vehicle is no longer: a road train (directive 96/53/EC)."""

ALIKE = 0.25
"""Parts of one vehicle are found with velocities that differ by no more than this share."""


def fit_targets(data: PassData, alone: Sequence[PassFit], paths: FloatArray, ground: GroundPrior,
                orders: Sequence[int], stopped: Callable[[], bool] | None = None
                ) -> tuple[tuple[PassFit, ...], ...]:
    """The fits of a pass for each of its targets.

    The number of targets cannot be told by the fit alone: a long row of dipoles describes two
    vehicles that follow each other, and two straight targets describe one that turns.

    Parameters
    ----------
    data : PassData
    alone : sequence of PassFit
        As of one target, with several numbers of dipoles.
    paths : (K, 6) [m], [m/s]
        Of the targets that were tracked, where they are when `data.t` is zero.
    ground : GroundPrior
    orders : sequence of int
        Numbers of dipoles to try where there are several.
    stopped : function, optional
        Whether to give up; what is returned is then of no use.

    Returns
    -------
    tuple of tuples of PassFit
        Of each target, with each number of dipoles. Those of one target where it describes the
        field as well, or where several would be parts of it: a long vehicle is now and then
        tracked as two. With a reason where neither one nor all that were tracked describe it.
    """
    n_targets = len(paths)
    if n_targets < 2 or len(data.sensors) < 2:
        return (tuple(alone),)
    if n_targets > MAX_TARGETS:
        return (_refused(alone, n_targets, f'at most {MAX_TARGETS} are fitted together'),)
    found = fit_joint(data, paths, ground, orders, stopped=stopped)
    if not found:
        return (_refused(alone, n_targets,
                         'there are too few measurements to fit them together'),)
    best, one = [_best(fits) for fits in found], _best(alone)
    if not one.reason and one.length[0] <= LONGEST and all(fit.determined for fit in best) and (
            _are_parts(data, best) or order_criteria([one, best[0]])[0] == 0.0):
        return (tuple(alone),)
    why = _why_not(data, best)
    return (_refused(alone, n_targets, why),) if why else found


def _best(fits: Sequence[PassFit]) -> PassFit:
    """The fit that `choose_order` looks at; the first one where none is determined."""
    return fits[int(np.argmin(order_criteria(fits)))]


def _are_parts(data: PassData, fits: Sequence[PassFit]) -> bool:
    """Whether targets move together, and overlap."""
    velocity = np.array([fit.velocity for fit in fits])
    mean = velocity.mean(axis=0)
    return bool((np.linalg.norm(velocity - mean, axis=1) <= ALIKE * np.linalg.norm(mean)).all()
                and not are_separate(data, [path_from(data, fit) for fit in fits]))


def _why_not(data: PassData, fits: Sequence[PassFit]) -> str:
    """Why targets that were fitted together are not believed, or nothing.

    An error in one of them affects the answers of all.
    """
    if not all(fit.converged for fit in fits):
        return 'the fit of them together did not converge'
    if not all(describes(fit) for fit in fits):
        return ('which at constant velocities leave over '
                f'{1.0 - fits[0].explained:.1%} of the field (a turn, braking, a further one)')
    if not are_separate(data, [path_from(data, fit) for fit in fits]):
        return 'which would overlap (a turn, braking, a further one)'
    for k, fit in enumerate(fits, 1):
        if fit.reason:
            return f'of vehicle {k}: {fit.reason}'
        if fit.length[0] > LONGEST:
            return f'of vehicle {k}: {fit.length[0]:.0f} m are longer than any vehicle'
    return ''


def _refused(fits: Sequence[PassFit], n_targets: int, why: str) -> tuple[PassFit, ...]:
    """The same with a reason, and nothing that is trusted."""
    reason = f'not one target: {n_targets} were tracked, {why}'
    return tuple(replace(fit, reason=reason, trusted=()) for fit in fits)
