"""How many dipoles a pass is worth."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray


def order_criteria(fits: Sequence[PassFit]) -> FloatArray:
    """The criterion of each fit of one pass; the smallest one wins.

    Every unknown has to earn log(n) (Schwarz's criterion, BIC): an order that is too large fits
    noise. The noise is known, so the cost is -2 log-likelihood but for a constant; it is first
    divided by the normalised cost of the richest fit (if that is above one): what no order
    describes is no reason to take the next one. TSP14 section V.C leaves the rule open.

    Parameters
    ----------
    fits : sequence of PassFit
        Of the same measurements.

    Returns
    -------
    (n,)
        Relative to the smallest; infinite for a fit that the measurements do not determine.
    """
    usable = [f for f in fits if f.determined]
    if not usable:
        return np.full(len(fits), np.inf)
    richest = max(usable, key=lambda f: f.n_dipoles)
    excess = max(1.0, richest.normalised_cost)
    criteria: FloatArray = np.array([f.cost / excess + f.n_unknowns * np.log(f.data.n_values)
                         if f.determined else np.inf for f in fits])
    relative: FloatArray = criteria - criteria.min()
    return relative


def choose_order(fits: Sequence[PassFit]) -> PassFit | None:
    """The fit with the smallest of `order_criteria`, or None where that one is no answer.

    A turn is not seen by a point that fits it badly: what the best fit contradicts holds for all.
    """
    criteria = order_criteria(fits)
    if not len(fits) or not np.isfinite(criteria).any():
        return None
    best = fits[int(np.argmin(criteria))]
    return None if best.reason else best
