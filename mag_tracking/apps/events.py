"""Description of the passes at each sensor of a network, without tracking."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.apps.readings import UserSource, network_of, source_of
from mag_tracking.event_records import PassEvent
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, Step, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.records import Readings
from mag_tracking.results.columns import EVENTS, row_of
from mag_tracking.results.dataframes import rows_dataframe
from mag_tracking.run import DisplayedResult, RunReport, progress_bar, run
from mag_tracking.stages.events.stage import Events

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class EventsResult(DisplayedResult):
    """Pass events in a recording."""

    events: tuple[PassEvent, ...]
    """Events in the order in which they ended."""
    report: RunReport
    """Losses, rejections and missing topics, with their causes."""

    def counts(self) -> dict[str, int]:
        """Count the events of each sensor.

        Returns
        -------
        dict of str to int
            {sensor: number of events}.
        """
        return dict(Counter(event.sensor for event in self.events))

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the events to a table.

        Returns
        -------
        pandas.DataFrame
            Columns of `events.csv`, indexed by the time of the closest point (UTC).
        """
        return rows_dataframe(EVENTS, [row_of(EVENTS, event) for event in self.events],
                              'closest_ns')

    def figure(self) -> 'Figure':
        """Draw the largest field of each event over time.

        Returns
        -------
        matplotlib.figure.Figure
        """
        # Imported here because it loads matplotlib.
        from mag_tracking.report.time_figures import time_figure

        return time_figure(np.array([e.closest_ns for e in self.events], dtype=np.int64),
                           np.array([1e9 * np.sqrt(np.nansum(e.peak**2)) for e in self.events]),
                           None, [e.sensor for e in self.events], 'largest field [nT]')

    def __repr__(self) -> str:
        counts = ', '.join(f'{n} of {name}' for name, n in self.counts().items())
        return f'EventsResult({quantity(len(self.events), "event")}: {counts or "none"})'


def events(source: UserSource, network: SensorNetwork | str | PathLike[str],
           settings: Mapping[str, Any] | None = None,
           time_unit: str | None = None) -> EventsResult:
    """Describe the passes that each sensor of a network detects.

    Parameters
    ----------
    source : path, Readings, RecordedReadings, DataFrame or mapping
        As for `track`.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        As for `track`.

    Returns
    -------
    EventsResult

    Raises
    ------
    ReadingsError
        If a table or arrays are incomplete, not in order, or of a wrong type.
    RecordingError, NetworkError
        As for `track`.
    SettingsError
        If a setting is invalid.
    """
    network = network_of(network)
    opened = source_of(source, network, time_unit)
    pipeline = Pipeline(network, settings_for('vehicle', settings), 'calibrate')
    sink = EventSink(pipeline)
    with progress_bar(opened, leave=False) as bar:
        return sink.result(run(opened, pipeline, [sink], bar.update))


class EventSink(RecordReceiver):
    """Collects the events in calibrated readings."""

    def __init__(self, pipeline: Pipeline) -> None:
        settings = pipeline.settings
        self._calibrate = pipeline.calibrate
        self._stage = Events(pipeline.network, settings.align, settings.detect, settings.track)
        self._events: list[PassEvent] = []

    def add(self, step: Step) -> None:
        """Find the events in the calibrated readings of a step."""
        self.receive(step.records)
        if step.is_last:
            self._events += self._stage.flush()

    def add_calibrated(self, readings: Readings) -> None:
        """Find the events in calibrated readings."""
        self._stage.set_relearnt(self._calibrate.backgrounds())
        self._events += self._stage.feed(readings)

    def result(self, report: RunReport) -> EventsResult:
        """Return the events after a run."""
        events = []
        for event in self._events:
            # `closest_std` includes the error of the timestamps.
            fault = self._calibrate.timestamps.worst_fault(event.sensor)
            events.append(event if fault is None else replace(
                event, closest_std=float(np.hypot(event.closest_std, fault.error_s))))
        return EventsResult(tuple(events), report)
