"""Fits of the passes in a stream of readings, as one vehicle or several."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.correlated_motion import CorrelatedMotion, correlated_motion
from mag_tracking.analysis.joint_fit import GroundPrior, are_separate, path_from
from mag_tracking.analysis.model_order import choose_order
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_result import MAX_COST_RATIO, PassFit
from mag_tracking.analysis.pass_targets import fit_targets
from mag_tracking.analysis.pass_trust import contradicts_straight_pass
from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.apps.pass_tracks import PassTracks, ground_prior
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.records import FieldFrame, Readings
from mag_tracking.stages.track.manager import TrackManager

MAX_TRAILER_DISTANCE = 8.0
"""Maximum distance between a car and its trailer [m]."""


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


class PassFitter:
    """Fits every pass in a stream of readings with each number of dipoles in `orders`.

    A tracker runs in parallel and determines the number of vehicles in each pass. `cpa_range` is
    the (range, std) [m] at the closest point of approach, only for a network of one sensor.
    """

    def __init__(self, recording: str, network: SensorNetwork, settings: Settings,
                 orders: Sequence[int], cpa_range: tuple[float, float] | None = None) -> None:
        self._recording = recording
        self.collector = PassCollector(network, settings, self._track)
        self._tracker = TrackManager(network, settings.track)
        self._tracks, self._ground = PassTracks(settings.track), ground_prior(settings.track)
        self._orders, self._cpa_range = tuple(orders), cpa_range
        self._n_passes = 0

    def feed(self, readings: Readings,
             stopped: Callable[[], bool] | None = None) -> Iterator[FittedPass]:
        """Add raw readings; the passes that they complete are fitted during the iteration."""
        return self._fit_passes(self.collector.feed(readings), stopped)

    def flush(self, stopped: Callable[[], bool] | None = None) -> Iterator[FittedPass]:
        """End the stream; the pass in progress is fitted during the iteration."""
        return self._fit_passes(self.collector.flush(), stopped)

    def _track(self, frame: FieldFrame) -> None:
        """Track the targets in a frame."""
        self._tracker.set_input_doubts(self.collector.calibrate.input_doubts())
        self._tracks.add(self._tracker.feed(frame))

    def _fit_passes(self, passes: Iterable[tuple[PassData, tuple[str, ...]]],
                    stopped: Callable[[], bool] | None) -> Iterator[FittedPass]:
        """Fit passes; discard a pass whose fitting is stopped."""
        for data, notes in passes:
            fits = []
            for n_dipoles in self._orders:
                if stopped is not None and stopped():
                    return
                fits.append(fit_pass(data, n_dipoles, self._cpa_range))
            self._n_passes += 1
            vehicles = fitted_vehicles(
                self._recording, self._n_passes, data, fits, self._tracks.paths(data),
                self._ground, self._orders, notes, stopped)
            if stopped is not None and stopped():
                return
            yield from vehicles


def fitted_vehicles(recording: str, number: int, data: PassData, single_fits: Sequence[PassFit],
                    paths: FloatArray, ground: GroundPrior, orders: Sequence[int],
                    notes: tuple[str, ...],
                    stopped: Callable[[], bool] | None = None) -> list[FittedPass]:
    """Fit the vehicles in detection `number` (from 1), jointly if there are several.

    `single_fits` are the fits as a single vehicle; `paths` (K, 6) [m, m/s, world frame] are the
    positions and velocities of the tracked vehicles when `data.t` is zero; `orders` are the numbers
    of dipoles for several vehicles. The result is invalid after `stopped` has returned true.
    """
    vehicles = fit_targets(data, single_fits, paths, ground, orders, stopped)
    if len(vehicles) == 1:
        return [FittedPass(recording, number, vehicles[0], notes, correlated_motion(data))]
    chosen = [fit for fit in map(choose_order, vehicles) if fit is not None]
    notes = (*notes, f'{len(vehicles)} vehicles were fitted together; the fitted field of the '
                     'other vehicles was subtracted from the measurements')
    if not are_separate(data, [path_from(data, fit) for fit in chosen], MAX_TRAILER_DISTANCE):
        notes = (*notes, f'the vehicles are less than {MAX_TRAILER_DISTANCE:.0f} m apart: they may '
                         'be parts of one vehicle')
    return [FittedPass(recording, number, fits, notes, CorrelatedMotion(
        'several vehicles passed together'), k, len(vehicles))
        for k, fits in enumerate(vehicles, 1)]
