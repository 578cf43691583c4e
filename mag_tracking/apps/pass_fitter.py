"""Readings to fitted passes: cut out, tracked, and fitted as one vehicle or several."""

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

TRAILER = 8.0
"""[m] A car and its trailer are rows that are nearer to each other than this."""


@dataclass(frozen=True)
class FittedPass:
    """A vehicle of a detection of a recording, fitted with several numbers of dipoles."""

    recording: str
    number: int
    """Number of the detection."""
    fits: tuple[PassFit, ...]
    notes: tuple[str, ...]
    """Measurements that were left out, with the reason, and remarks."""
    correlated: CorrelatedMotion = CorrelatedMotion()
    """The velocity by the delays between the sensors, which needs no model; missing if several
    vehicles were fitted together."""
    vehicle: int = 1
    """Number among the vehicles that were fitted together, in the order in which they passed."""
    n_vehicles: int = 1

    @property
    def label(self) -> str:
        """Its name in texts and files."""
        return f'pass {self.number}' + (f', vehicle {self.vehicle}' if self.n_vehicles > 1 else '')

    @property
    def chosen(self) -> PassFit | None:
        """The fit of the order that the measurements are worth, or None."""
        return choose_order(self.fits)

    @property
    def known(self) -> PassFit | None:
        """The fit whose trusted numbers count: the chosen one, else the one that fits best.

        None where any fit says that the target turned or was not one: that holds for all.
        """
        if self.chosen is not None:
            return self.chosen
        usable = [f for f in self.fits if f.converged and f.trusted]
        if not usable or any(contradicts_straight_pass(f) for f in self.fits if f.converged):
            return None
        return min(usable, key=lambda f: f.normalised_cost)

    @property
    def disagreement(self) -> tuple[float, float]:
        """Largest difference [m], [m/s] to the chosen fit of those with nearly its cost.

        That is what the model leaves open. NaN where there is no other fit, and where the chosen
        one describes the measurements to the noise: then richer ones only fit noise.
        """
        best = self.chosen
        if best is None or not best.cost > energy_threshold(1e-3, best.degrees_of_freedom):
            return np.nan, np.nan
        others = [f for f in self.fits if f is not best and not f.reason
                  and f.normalised_cost <= MAX_COST_RATIO * best.normalised_cost]
        if not others:
            return np.nan, np.nan
        return (max(float(np.linalg.norm(f.position - best.position)) for f in others),
                max(float(np.linalg.norm(f.velocity - best.velocity)) for f in others))


class PassFitter:
    """Fits every pass of a stream of readings, one after the other.

    A tracker runs in parallel and determines the number of vehicles of a pass.

    Attributes
    ----------
    collector : PassCollector
    """

    def __init__(self, recording: str, network: SensorNetwork, settings: Settings,
                 orders: Sequence[int], cpa_range: tuple[float, float] | None = None) -> None:
        """`recording` is its name; the others as for `apps.fit.RecordingFit`."""
        self._recording = recording
        self.collector = PassCollector(network, settings, self._track)
        self._tracker = TrackManager(network, settings.track)
        self._tracks, self._ground = PassTracks(settings.track), ground_prior(settings.track)
        self._orders, self._cpa_range = tuple(orders), cpa_range
        self._n = 0

    def feed(self, readings: Readings,
             stopped: Callable[[], bool] | None = None) -> Iterator[FittedPass]:
        """Iterate over what raw `Readings` complete, until `stopped` says so."""
        return self._fitted(self.collector.feed(readings), stopped)

    def flush(self, stopped: Callable[[], bool] | None = None) -> Iterator[FittedPass]:
        """The readings have ended: the pass that was still going on."""
        return self._fitted(self.collector.flush(), stopped)

    def _track(self, frame: FieldFrame) -> None:
        """Take a frame for the tracks."""
        self._tracker.doubt(self.collector.calibrate.doubtful_intervals())
        self._tracks.take(self._tracker.feed(frame))

    def _fitted(self, passes: Iterable[tuple[PassData, tuple[str, ...]]],
                stopped: Callable[[], bool] | None) -> Iterator[FittedPass]:
        """The fits of what the collector gave; a pass that is stopped in the middle is left out."""
        for data, notes in passes:
            fits = []
            for n_dipoles in self._orders:
                if stopped is not None and stopped():
                    return
                fits.append(fit_pass(data, n_dipoles, self._cpa_range))
            self._n += 1
            found = fitted_vehicles(self._recording, self._n, data, fits, self._tracks.paths(data),
                                    self._ground, self._orders, notes, stopped)
            if stopped is not None and stopped():
                return
            yield from found


def fitted_vehicles(recording: str, number: int, data: PassData, alone: Sequence[PassFit],
                    paths: FloatArray, ground: GroundPrior, orders: Sequence[int],
                    notes: tuple[str, ...],
                    stopped: Callable[[], bool] | None = None) -> list[FittedPass]:
    """A `FittedPass` of each vehicle of a pass.

    `recording`, `number` and `notes` are those of the `FittedPass`; the others as for
    `analysis.pass_targets.fit_targets`.
    """
    found = fit_targets(data, alone, paths, ground, orders, stopped)
    if len(found) == 1:
        return [FittedPass(recording, number, found[0], notes, correlated_motion(data))]
    chosen = [fit for fit in map(choose_order, found) if fit is not None]
    notes = (*notes, f'{len(found)} vehicles were fitted together: what was measured is given '
                     'without the field of the others')
    if not are_separate(data, [path_from(data, fit) for fit in chosen], TRAILER):
        notes = (*notes, f'they are less than {TRAILER:.0f} m apart: perhaps parts of one vehicle')
    return [FittedPass(recording, number, fits, notes, CorrelatedMotion(
        'several vehicles were seen at once'), k, len(found)) for k, fits in enumerate(found, 1)]
