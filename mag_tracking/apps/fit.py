"""Offline fits of the passes in a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.analysis.fitted_pass import FittedPass
from mag_tracking.apps.passes import PassFitter
from mag_tracking.apps.readings import UserSource, network_of, source_of
from mag_tracking.errors import SettingsError, UnknownTrackError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.results.columns import FITS, names_of
from mag_tracking.results.dataframes import dataframe
from mag_tracking.results.fit_folder import pass_rows
from mag_tracking.run import DisplayedResult, RunReport, progress_bar, run

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class FitResult(DisplayedResult):
    """Fitted passes of a recording."""

    passes: tuple[FittedPass, ...]
    """One entry per pass and vehicle."""
    report: RunReport
    """Losses, rejections and missing topics, with their causes."""

    def __repr__(self) -> str:
        notes = self.report.warnings()
        return (f'FitResult({quantity(len(self.passes), "pass", "passes")}'
                + (f'; {"; ".join(notes)}' if notes else '') + ')')

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the fits to a table, which requires pandas.

        Returns
        -------
        pandas.DataFrame
            One row per pass and number of dipoles, with the columns of `fits.csv`.
        """
        rows = [row for fitted in self.passes for row in pass_rows(fitted)]
        # A fit without an estimate has an empty string in this column.
        return dataframe(FITS, {c: [np.nan if c == 'ambiguous' and row[c] == '' else row[c]
                                    for row in rows] for c in names_of(FITS)})

    def figure(self, number: int = 0) -> 'Figure':
        """Draw the measured and fitted field of a pass.

        Parameters
        ----------
        number : int, optional
            Index in `passes`.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        UnknownTrackError
            If there is no such pass, or nothing could be fitted to it.
        """
        # Imported here because it loads matplotlib.
        from mag_tracking.apps.fit_report import pass_figure

        drawn = self.passes[number].drawn if 0 <= number < len(self.passes) else None
        if drawn is None:
            raise UnknownTrackError(f'no fit of pass {number}; passes: {len(self.passes)}')
        return pass_figure(drawn, self.passes[number].label)


def fit(source: UserSource, network: SensorNetwork | str | PathLike[str],
        settings: Mapping[str, Any] | None = None, orders: Sequence[int] = (1, 2, 3, 4),
        cpa_range: tuple[float, float] | None = None, time_unit: str | None = None) -> FitResult:
    """Fit every pass in a recording as a row of dipoles at constant velocity.

    Up to three simultaneous vehicles are fitted together.

    Parameters
    ----------
    source : path, Readings, RecordedReadings, DataFrame or mapping
        As for `track`.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle.
    orders : sequence of int
        Numbers of dipoles to try, 1 to 8.
    cpa_range : (range, std), m, optional
        Range at the closest point of approach, only for a network of one sensor; see
        `analysis.pass_fit.fit_pass`.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        As for `track`.

    Returns
    -------
    FitResult

    Raises
    ------
    ReadingsError
        If a table or arrays are incomplete, not in order, or of a wrong type.
    RecordingError, NetworkError
        As for `track`.
    SettingsError
        If a setting or an argument is invalid.
    """
    network = network_of(network)
    check_orders('orders', orders)
    check_cpa_range('cpa_range', cpa_range, network)
    passes: list[FittedPass] = []
    opened = source_of(source, network, time_unit)
    pipeline = Pipeline(network, settings_for('vehicle', settings), 'track')
    fitter = PassFitter(opened.stem, pipeline, orders, cpa_range, passes.append)
    with progress_bar(opened, leave=False) as bar:
        report = run(opened, pipeline, [fitter], bar.update)
    return FitResult(tuple(passes), report)


def check_orders(name: str, orders: Sequence[int]) -> None:
    """Raise SettingsError unless the numbers of dipoles are distinct and from 1 to 8."""
    if not len(orders) or min(orders) < 1 or max(orders) > 8 or len(set(orders)) < len(orders):
        raise SettingsError(f'{name}: expected different numbers from 1 to 8, got {list(orders)}')


def check_cpa_range(name: str, cpa_range: Sequence[float] | None, network: SensorNetwork) -> None:
    """Raise SettingsError unless (range, std) [m] are positive and there is a single sensor."""
    if cpa_range is None:
        return
    if len(network) > 1:
        raise SettingsError(f'{name}: only for a single sensor; the {len(network)} sensors of the '
                            'network already determine the scale')
    if len(cpa_range) != 2 or not (np.isfinite(cpa_range).all() and min(cpa_range) > 0.0):
        raise SettingsError(f'{name}: expected two positive numbers, got {list(cpa_range)}')
