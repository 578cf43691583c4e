"""Fits of the passes in a stream of readings, as one vehicle or several."""

from collections.abc import Callable, Iterable, Iterator, Sequence

from mag_tracking.analysis.correlated_motion import CorrelatedMotion, correlated_motion
from mag_tracking.analysis.fitted_pass import FittedPass, choose_order
from mag_tracking.analysis.joint_fit import GroundPrior, are_separate, fit_targets, path_from
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.apps.pass_tracks import PassTracks, ground_prior
from mag_tracking.arrays import FloatArray
from mag_tracking.pipeline import Pipeline
from mag_tracking.record_receiver import Step

MAX_TRAILER_DISTANCE = 8.0
"""Maximum distance between a car and its trailer [m]."""


class PassFitter:
    """Sink that fits every pass as a row of dipoles, for each number of dipoles in `orders`.

    The tracks determine the number of vehicles in each pass. Each result is passed to `report`.
    `cpa_range` is (range, std) at the closest point of approach [m], only for a single sensor.
    """

    def __init__(self, recording: str, pipeline: Pipeline, orders: Sequence[int],
                 cpa_range: tuple[float, float] | None, report: Callable[[FittedPass], object],
                 stopped: Callable[[], bool] | None = None) -> None:
        self._recording, self._collector = recording, PassCollector(pipeline)
        track = pipeline.settings.track
        self._tracks, self._ground = PassTracks(track), ground_prior(track)
        self._orders, self._cpa_range = tuple(orders), cpa_range
        self._report, self._stopped, self._n_passes = report, stopped, 0

    def add(self, step: Step) -> None:
        """Fit the passes that end with a step; fitting ends when `stopped` returns true."""
        if not step.is_last:
            # A vehicle that still approaches at the end of the source does not belong to a pass.
            self._tracks.add(step.records)
        for fitted_pass in self._fit_passes(self._collector.passes(step), self._stopped):
            self._report(fitted_pass)

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
