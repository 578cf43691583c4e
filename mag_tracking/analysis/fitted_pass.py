"""Fits of one vehicle in a detection, and the choice between numbers of dipoles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.correlated_motion import CorrelatedMotion
from mag_tracking.analysis.pass_result import MAX_COST_RATIO, PassFit
from mag_tracking.analysis.pass_trust import contradicts_straight_pass
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.detection_theory import energy_threshold


def order_criteria(fits: Sequence[PassFit]) -> FloatArray:
    """Bayesian information criterion (Schwarz) of each fit of one pass, minus the smallest value.

    Infinite for a fit that is not determined. If the normalised cost of the fit with the most
    dipoles exceeds one, all costs are divided by it: a residual that no order explains is no
    evidence for a higher order. TSP14 section V.C does not specify a criterion.
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


@dataclass(frozen=True)
class FittedPass:
    """One vehicle in a detection, fitted with several numbers of dipoles."""

    recording: str
    """Name of the recording."""
    number: int
    """Index of the detection in the recording, from 1."""
    fits: tuple[PassFit, ...]
    """One fit per number of dipoles."""
    notes: tuple[str, ...]
    """Remarks for the user, such as unused measurements and the reason."""
    correlated: CorrelatedMotion = CorrelatedMotion()
    """Velocity from the delays between the sensors, independent of the model; missing if several
    vehicles were fitted together."""
    vehicle: int = 1
    """Index among the vehicles that were fitted together, from 1, in the order of passing."""
    n_vehicles: int = 1
    """Number of vehicles that were fitted together."""

    @property
    def label(self) -> str:
        """Name for messages and file names, such as `pass 3` or `pass 3, vehicle 2`."""
        return f'pass {self.number}' + (f', vehicle {self.vehicle}' if self.n_vehicles > 1 else '')

    @property
    def drawn(self) -> PassFit | None:
        """Chosen fit or, without one, the fit with the most dipoles; None if nothing was fitted."""
        return self.chosen or next((f for f in reversed(self.fits) if len(f.x)), None)

    @property
    def chosen(self) -> PassFit | None:
        """Fit with the number of dipoles that the measurements support; None if it is rejected."""
        return choose_order(self.fits)

    @property
    def reported(self) -> PassFit | None:
        """Fit whose trusted values are reported: the chosen fit, or else the fit of lowest cost.

        Without a chosen fit, the result is None if no fit has trusted values, or if any fit shows
        that the target turned or was not a single target.
        """
        if self.chosen is not None:
            return self.chosen
        usable_fits = [f for f in self.fits if f.converged and f.trusted]
        if not usable_fits or any(contradicts_straight_pass(f) for f in self.fits if f.converged):
            return None
        return min(usable_fits, key=lambda f: f.normalised_cost)

    @property
    def disagreement(self) -> tuple[float, float]:
        """Largest differences between the chosen fit and fits with a similar cost.

        The differences in position [m] and in velocity [m/s] indicate the error of the model. They
        are NaN if there is no chosen fit, or no other fit with a similar cost. They are also NaN if
        the residuals of the chosen fit are consistent with the noise, because additional dipoles
        then fit only noise.
        """
        chosen = self.chosen
        if chosen is None or not chosen.cost > energy_threshold(1e-3, chosen.degrees_of_freedom):
            return np.nan, np.nan
        similar_fits = [f for f in self.fits if f is not chosen and not f.reason
                        and f.normalised_cost <= MAX_COST_RATIO * chosen.normalised_cost]
        if not similar_fits:
            return np.nan, np.nan
        return (max(float(np.linalg.norm(f.position - chosen.position)) for f in similar_fits),
                max(float(np.linalg.norm(f.velocity - chosen.velocity)) for f in similar_fits))
