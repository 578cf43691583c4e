"""Selection of the number of dipoles of a pass."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray


def order_criteria(fits: Sequence[PassFit]) -> FloatArray:
    """Bayesian information criterion (Schwarz) of each fit of one pass, minus the smallest value.

    Each unknown adds log(n) to the cost, which is -2 times the log-likelihood up to a constant. If
    the normalised cost of the fit with the most dipoles exceeds one, all costs are divided by it: a
    residual that no order explains is no evidence for a higher order. Infinite for a fit that is
    not determined. TSP14 section V.C does not specify a criterion.
    """
    determined_fits = [f for f in fits if f.determined]
    if not determined_fits:
        return np.full(len(fits), np.inf)
    highest_order = max(determined_fits, key=lambda f: f.n_dipoles)
    cost_scale = max(1.0, highest_order.normalised_cost)
    criteria: FloatArray = np.array([f.cost / cost_scale + f.n_unknowns * np.log(f.data.n_values)
                                     if f.determined else np.inf for f in fits])
    relative: FloatArray = criteria - criteria.min()
    return relative


def choose_order(fits: Sequence[PassFit]) -> PassFit | None:
    """Return the fit with the smallest criterion, or None if that fit is rejected.

    Another order does not replace a rejected fit, because a fit with fewer dipoles does not always
    reveal that the target turned.
    """
    criteria = order_criteria(fits)
    if not len(fits) or not np.isfinite(criteria).any():
        return None
    best = fits[int(np.argmin(criteria))]
    return None if best.reason else best
