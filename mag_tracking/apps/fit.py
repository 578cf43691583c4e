"""Offline fits of the passes in a recording."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.apps.pass_fitter import FittedPass, PassFitter
from mag_tracking.apps.prescan import prescan_of
from mag_tracking.apps.readings import network_of
from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.recording.fit_folder import FIT_COLUMNS, pass_rows
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.report.dataframes import STATE_UNITS, dataframe
from mag_tracking.stages.calibrate.field_comparison import earth_field_findings

if TYPE_CHECKING:
    import pandas as pd

FIT_UNITS = {
    **STATE_UNITS, **dict.fromkeys(('sd_mx', 'sd_my', 'sd_mz'), 'A m^2'),
    **dict.fromkeys(('speed', 'sd_speed'), 'm/s'),
    **dict.fromkeys(('heading_deg', 'sd_heading_deg'), 'deg'),
    **dict.fromkeys(('cpa_time', 'sd_cpa_time'), 's'),
    **dict.fromkeys(('cpa_range', 'sd_cpa_range'), 'm'),
    **dict.fromkeys(('rate', 'sd_rate'), '1/s'),
    **dict.fromkeys(('delay_speed', 'sd_delay_speed'), 'm/s'),
    **dict.fromkeys(('delay_heading_deg', 'sd_delay_heading_deg'), 'deg')}
"""Units of the columns of `fits.csv`: {column: unit}."""


class RecordingFit:
    """Fits every pass in a recording with each number of dipoles in `orders`.

    `cpa_range` is the (range, std) [m] at the closest point of approach, only for a network of one
    sensor (`analysis.pass_fit.fit_pass`).
    """

    def __init__(self, recording: Recording, network: SensorNetwork, settings: Settings,
                 orders: Sequence[int], cpa_range: tuple[float, float] | None = None) -> None:
        self._fitter = PassFitter(recording.path.resolve().stem, network, settings, orders,
                                  cpa_range)
        self._recording = recording
        self._reader = SampleReader(recording, network)
        self._network, self._settings = network, settings.calibrate

    def passes(self, progress: Callable[[int], object] | None = None,
               stopped: Callable[[], bool] | None = None) -> Iterator[FittedPass]:
        """Read the recording, fit each pass, and yield the results.

        `stopped` is called after every batch of readings and every fit.
        """
        prescan_of(self._recording, self._network, self._settings,
                   stopped).apply(self._fitter.collector.calibrate)
        for readings in self._reader.readings(progress):
            if stopped is not None and stopped():
                return
            yield from self._fitter.feed(readings, stopped)
        yield from self._fitter.flush(stopped)

    def warnings(self) -> list[str]:
        """Describe missing topics, backgrounds and detections, and faulty or rejected readings, one
        a line."""
        collector = self._fitter.collector
        lines = [f'no messages on {topic}' for topic in self._reader.missing_topics()]
        lines += [f'no background was learnt for {name}: its quiet intervals are too short; '
                  'set background and noise_std in the network file'
                  for name in collector.sensors_without_background()]
        lines += [str(f) for f in earth_field_findings(
            collector.calibrate.field_inconsistencies())]
        reason = collector.no_detection_reason(self._reader.missing_topics())
        lines += [f'nothing was detected: {reason}'] if reason else []
        for counts in (self._reader.rejected, collector.rejected, self._recording.losses):
            lines += [f'{cause}: {n}' for cause, n in counts.items()]
        return lines


@dataclass(frozen=True, eq=False)
class FitResult:
    """Fitted passes of a recording."""

    passes: tuple[FittedPass, ...]
    """One entry per pass and vehicle."""
    warnings: tuple[str, ...]
    """Warnings about missing topics, backgrounds or detections, and lost or rejected readings."""

    def __repr__(self) -> str:
        return (f'FitResult({quantity(len(self.passes), "pass", "passes")}'
                + (f'; warnings: {"; ".join(self.warnings)}' if self.warnings else '') + ')')

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the fits to a table.

        Returns
        -------
        pandas.DataFrame
            One row per pass and number of dipoles, with the columns of `fits.csv`.

        Raises
        ------
        MissingDependencyError
            If pandas is not installed.
        """
        rows = [row for fitted in self.passes for row in pass_rows(fitted)]
        # A fit without an estimate has an empty string in this column.
        columns = {c: [np.nan if c == 'ambiguous' and row[c] == '' else row[c] for row in rows]
                   for c in FIT_COLUMNS}
        return dataframe(columns, FIT_UNITS)


def fit(recording: str | PathLike[str], network: SensorNetwork | str | PathLike[str],
        settings: Mapping[str, Any] | None = None, orders: Sequence[int] = (1, 2, 3, 4),
        cpa_range: tuple[float, float] | None = None) -> FitResult:
    """Fit every pass in a recording as a row of dipoles at constant velocity.

    Up to three simultaneous vehicles are fitted together.

    Parameters
    ----------
    recording : path
        An .mcap, .db3 or .bag file, or a rosbag2 folder.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle.
    orders : sequence of int
        Numbers of dipoles to try, 1 to 8.
    cpa_range : (range, std), m, optional
        Range at the closest point of approach, only for a network of one sensor; see
        `analysis.pass_fit.fit_pass`.

    Returns
    -------
    FitResult

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is invalid.
    SettingsError
        If a setting or an argument is invalid.
    """
    network = network_of(network)
    check_orders('orders', orders)
    check_cpa_range('cpa_range', cpa_range, network)
    job = RecordingFit(Recording(recording), network, settings_for('vehicle', settings), orders,
                       cpa_range)
    passes = tuple(job.passes())
    return FitResult(passes, tuple(job.warnings()))


def check_orders(name: str, orders: Sequence[int]) -> None:
    """Raise SettingsError unless the numbers of dipoles are distinct and from 1 to 8."""
    if not len(orders) or min(orders) < 1 or max(orders) > 8 or len(set(orders)) < len(orders):
        raise SettingsError(f'{name}: expected different numbers from 1 to 8, got {list(orders)}')


def check_cpa_range(name: str, cpa_range: Sequence[float] | None, network: SensorNetwork) -> None:
    """Raise SettingsError unless (range, std) [m] are positive and the network has a single
    sensor."""
    if cpa_range is None:
        return
    if len(network) > 1:
        raise SettingsError(f'{name}: only for a single sensor; the {len(network)} sensors of the '
                            'network already determine the scale')
    if len(cpa_range) != 2 or not (np.isfinite(cpa_range).all() and min(cpa_range) > 0.0):
        raise SettingsError(f'{name}: expected two positive numbers, got {list(cpa_range)}')
