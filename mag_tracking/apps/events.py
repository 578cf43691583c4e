"""Description of the passes at each sensor of a network, without tracking."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.apps.input_findings import input_findings
from mag_tracking.apps.prescan import prescan_of
from mag_tracking.apps.readings import network_of
from mag_tracking.event_records import PassEvent
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.events.stage import Events
from mag_tracking.stages.health.diagnosis import Diagnosis, ranked
from mag_tracking.stages.stage import rejected


@dataclass(frozen=True, eq=False)
class EventsResult:
    """Pass events in a recording."""

    events: tuple[PassEvent, ...]
    """Events in the order in which they ended."""
    rejections: dict[str, int]
    """Readings that were not used: {cause: number}."""
    sensors_without_background: tuple[str, ...]
    """Sensors whose background was not learnt."""
    missing_topics: tuple[str, ...]
    """Topics of the network that are not in the recording."""
    diagnoses: tuple[Diagnosis, ...]
    """Diagnoses of the recording and the sensors."""

    def counts(self) -> dict[str, int]:
        """Count the events of each sensor.

        Returns
        -------
        dict of str to int
            {sensor: number of events}.
        """
        return dict(Counter(event.sensor for event in self.events))

    def __repr__(self) -> str:
        counts = ', '.join(f'{n} of {name}' for name, n in self.counts().items())
        return f'EventsResult({quantity(len(self.events), "event")}: {counts or "none"})'


def events(recording: str | PathLike[str], network: SensorNetwork | str | PathLike[str],
           settings: Mapping[str, Any] | None = None) -> EventsResult:
    """Describe the passes that each sensor of a network detects.

    Parameters
    ----------
    recording : path
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle.

    Returns
    -------
    EventsResult

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is invalid.
    SettingsError
        If a setting is invalid.
    """
    return find_events(Recording(recording), network_of(network), settings_for('vehicle', settings))


def find_events(recording: Recording, network: SensorNetwork, settings: Settings,
                progress: Callable[[int], object] | None = None,
                stopped: Callable[[], bool] | None = None) -> EventsResult:
    """Describe the passes in an open recording."""
    reader = SampleReader(recording, network)
    calibrate = Calibrate(network, settings.calibrate, survey=settings.survey)
    stage = Events(network, settings.align, settings.detect, settings.track)
    prescan_of(recording, network, settings.calibrate, stopped).apply(calibrate)
    pass_events: list[PassEvent] = []
    try:
        for readings in until_stopped(reader.readings, progress, stopped):
            for calibrated in calibrate.feed(readings):
                stage.set_relearnt(calibrate.backgrounds())
                pass_events += stage.feed(calibrated)
    except ReadingStopped:
        pass
    for calibrated in calibrate.flush():
        pass_events += stage.feed(calibrated)
    pass_events += stage.flush()
    pass_events = [_with_timestamp_error(event, calibrate) for event in pass_events]
    return EventsResult(tuple(pass_events),
                        dict(reader.rejected + Counter(rejected(calibrate.counts))),
                        tuple(calibrate.unready()), tuple(reader.missing_topics()),
                        tuple(ranked(input_findings(recording, reader, network, calibrate,
                                                    settings.track))))


def _with_timestamp_error(event: PassEvent, calibrate: Calibrate) -> PassEvent:
    """Event whose `closest_std` includes the error of the timestamps of its sensor."""
    fault = calibrate.timestamps.worst_fault(event.sensor)
    return event if fault is None else replace(
        event, closest_std=float(np.hypot(event.closest_std, fault.error_s)))
