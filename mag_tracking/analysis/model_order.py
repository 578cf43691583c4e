"""Selection of the number of dipoles of a pass."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.arrays import FloatArray


def order_criteria(fits: Sequence[PassFit]) -> FloatArray:
    """Information criterion of each fit of one pass; the smallest is selected.

    The criterion is the Bayesian information criterion (BIC, Schwarz): each unknown is penalised
    by log(n), so that orders that only fit noise are not selected. The noise is known, hence the
    cost is -2 times the log-likelihood up to a constant. The cost is first divided by the
    normalised cost of the fit with the most dipoles if that exceeds one, since a residual that no
    order explains is no evidence for a higher order. TSP14 section V.C leaves the criterion open.

    Parameters
    ----------
    fits : sequence of PassFit
        Fits of the same measurements.

    Returns
    -------
    (n,) array
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
    """Return the fit with the smallest criterion, or None if that fit is rejected.

    A point can fit a turn poorly without indicating it, so a rejection of the best fit holds for
    all orders.

    Parameters
    ----------
    fits : sequence of PassFit
        Fits of the same measurements.

    Returns
    -------
    PassFit or None
    """
    criteria = order_criteria(fits)
    if not len(fits) or not np.isfinite(criteria).any():
        return None
    best = fits[int(np.argmin(criteria))]
    return None if best.reason else best
