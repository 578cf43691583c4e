"""Fit the passes of a recording, offline."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.analysis.correlated_motion import CorrelatedMotion, correlated_motion
from mag_tracking.analysis.model_order import choose_order
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import contradicted
from mag_tracking.apps.first_pass import first_pass_of
from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.apps.readings import network_of
from mag_tracking.errors import SettingsError
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.recording.fit_folder import FIT_COLUMNS, pass_rows
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.report.dataframes import STATE_UNITS, dataframe

if TYPE_CHECKING:
    import pandas as pd

NEARLY = 1.25
"""A fit whose cost is not larger than this times that of the best describes the pass as well."""


FIT_UNITS = {
    **STATE_UNITS, **dict.fromkeys(('sd_mx', 'sd_my', 'sd_mz'), 'A m^2'),
    **dict.fromkeys(('speed', 'sd_speed'), 'm/s'),
    **dict.fromkeys(('heading_deg', 'sd_heading_deg'), 'deg'),
    **dict.fromkeys(('cpa_time', 'sd_cpa_time'), 's'),
    **dict.fromkeys(('cpa_range', 'sd_cpa_range'), 'm'),
    **dict.fromkeys(('rate', 'sd_rate'), '1/s'),
    **dict.fromkeys(('delay_speed', 'sd_delay_speed'), 'm/s'),
    **dict.fromkeys(('delay_heading_deg', 'sd_delay_heading_deg'), 'deg')}
"""Units of the columns of `fits.csv`."""


@dataclass(frozen=True)
class FittedPass:
    """One detection of a recording, fitted with several numbers of dipoles."""

    recording: str
    number: int
    fits: tuple[PassFit, ...]
    notes: tuple[str, ...]
    """What was left out of the measurements, and why."""
    correlated: CorrelatedMotion = CorrelatedMotion()
    """The velocity by the delays between the sensors, which needs no model."""

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
        if not usable or any(contradicted(f) for f in self.fits if f.converged):
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
                  and f.normalised_cost <= NEARLY * best.normalised_cost]
        if not others:
            return np.nan, np.nan
        return (max(float(np.linalg.norm(f.position - best.position)) for f in others),
                max(float(np.linalg.norm(f.velocity - best.velocity)) for f in others))


class RecordingFit:
    """Fits every pass of a recording, one after the other.

    Parameters
    ----------
    recording : Recording
    network : SensorNetwork
    settings : Settings
        Of calibration, alignment and detection.
    orders : sequence of int
        Numbers of dipoles.
    cpa_range : (range, std) [m], optional
        For a network of one sensor; see `fit_pass`.

    Raises RecordingError where the recording does not fit the network.
    """

    def __init__(self, recording: Recording, network: SensorNetwork, settings: Settings,
                 orders: Sequence[int], cpa_range: tuple[float, float] | None = None) -> None:
        self._name = recording.path.resolve().stem
        self._recording = recording
        self._reader = SampleReader(recording, network)
        self._network, self._settings = network, settings.calibrate
        self._collector = PassCollector(network, settings)
        self._orders, self._cpa_range = tuple(orders), cpa_range
        self._n = 0

    def passes(self, progress: Callable[[int], object] | None = None,
               stopped: Callable[[], bool] | None = None) -> Iterator[FittedPass]:
        """Iterate over the `FittedPass`es, each as soon as it is done.

        `progress` and `stopped` are as for `apps.replay.replay`.
        """
        first_pass_of(self._recording, self._network, self._settings,
                      stopped).apply(self._collector.calibrate)
        for readings in self._reader.readings(progress):
            if stopped is not None and stopped():
                return
            yield from self._fitted(self._collector.feed(readings), stopped)
        yield from self._fitted(self._collector.flush(), stopped)

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
            yield FittedPass(self._name, self._n, tuple(fits), notes, correlated_motion(data))

    def warnings(self) -> list[str]:
        """What was lost or rejected, and which sensors were never heard; a list of lines."""
        lines = [f'nothing on {topic}' for topic in self._reader.missing_topics()]
        lines += [f'no background was learnt for {name}: the field was not steady for long enough; '
                  'give background and noise_std in the network file'
                  for name in self._collector.waiting()]
        why = self._collector.why_no_detection(self._reader.missing_topics())
        lines += [f'nothing was detected: {why}'] if why else []
        for counts in (self._reader.rejected, self._collector.rejected, self._recording.losses):
            lines += [f'{cause}: {n}' for cause, n in counts.items()]
        return lines


@dataclass(frozen=True, eq=False)
class FitResult:
    """The fitted passes of a recording."""

    passes: tuple[FittedPass, ...]
    warnings: tuple[str, ...]
    """Readings that were lost or rejected, and sensors that were not used."""

    def __repr__(self) -> str:
        return (f'FitResult({len(self.passes)} passes'
                + (f'; warnings: {"; ".join(self.warnings)}' if self.warnings else '') + ')')

    def to_dataframe(self) -> 'pd.DataFrame':
        """One row a pass and number of dipoles, with the columns of `fits.csv`.

        Raises
        ------
        MissingDependencyError
        """
        rows = [row for one in self.passes for row in pass_rows(one)]
        # A fit without an answer has no number there.
        columns = {c: [np.nan if c == 'ambiguous' and row[c] == '' else row[c] for row in rows]
                   for c in FIT_COLUMNS}
        return dataframe(columns, FIT_UNITS)


def fit(recording: str | PathLike[str], network: SensorNetwork | str | PathLike[str],
        settings: Mapping[str, Any] | None = None, orders: Sequence[int] = (1, 2, 3, 4),
        cpa_range: tuple[float, float] | None = None) -> FitResult:
    """Fit every pass of a recording as a row of dipoles at constant velocity.

    Parameters
    ----------
    recording : path
        An .mcap, .db3 or .bag file, or a rosbag2 folder.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        What differs from the defaults for a vehicle.
    orders : sequence of int
        Numbers of dipoles to try, 1 to 8.
    cpa_range : (range, std) [m], optional
        For a network of one sensor; see `analysis.pass_fit.fit_pass`.

    Returns
    -------
    FitResult

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is not valid.
    SettingsError
        If a setting or an argument is not valid.
    """
    network = network_of(network)
    check_orders('orders', orders)
    check_cpa_range('cpa_range', cpa_range, network)
    job = RecordingFit(Recording(recording), network, settings_for('vehicle', settings), orders,
                       cpa_range)
    passes = tuple(job.passes())
    return FitResult(passes, tuple(job.warnings()))


def check_orders(name: str, orders: Sequence[int]) -> None:
    """Raise SettingsError, which begins with `name`, unless `orders` are different, 1 to 8."""
    if not len(orders) or min(orders) < 1 or max(orders) > 8 or len(set(orders)) < len(orders):
        raise SettingsError(f'{name}: expected different numbers from 1 to 8, got {list(orders)}')


def check_cpa_range(name: str, cpa_range: Sequence[float] | None, network: SensorNetwork) -> None:
    """Raise SettingsError, which begins with `name`, for a range that is not valid."""
    if cpa_range is None:
        return
    if len(network) > 1:
        raise SettingsError(f'{name} is for one sensor; the network has {len(network)}, '
                            'which tell the scale themselves')
    if len(cpa_range) != 2 or not (np.isfinite(cpa_range).all() and min(cpa_range) > 0.0):
        raise SettingsError(f'{name}: expected two positive numbers, got {list(cpa_range)}')
