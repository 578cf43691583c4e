"""Passes described by each sensor of a network, without tracking and without metres."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

from mag_tracking.apps.prescan import prescan_of
from mag_tracking.apps.readings import network_of
from mag_tracking.event_records import PassEvent
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.events.stage import Events
from mag_tracking.stages.stage import rejected


@dataclass(frozen=True, eq=False)
class EventsResult:
    """The events of a recording."""

    events: tuple[PassEvent, ...]
    """In the order in which they ended."""
    rejections: dict[str, int]
    """{cause: number} of readings that were not used."""
    sensors_without_background: tuple[str, ...]
    missing_topics: tuple[str, ...]

    def counts(self) -> dict[str, int]:
        """{sensor: number of events}."""
        return dict(Counter(event.sensor for event in self.events))

    def __repr__(self) -> str:
        counts = ', '.join(f'{n} of {name}' for name, n in self.counts().items())
        return f'EventsResult({len(self.events)} events: {counts or "none"})'


def events(recording: str | PathLike[str], network: SensorNetwork | str | PathLike[str],
           settings: Mapping[str, Any] | None = None) -> EventsResult:
    """Describe the passes that each sensor of a network detects.

    Parameters
    ----------
    recording : path
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        What differs from the defaults for a vehicle.

    Returns
    -------
    EventsResult

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is not valid.
    SettingsError
        If a setting is not valid.
    """
    return find_events(Recording(recording), network_of(network), settings_for('vehicle', settings))


def find_events(recording: Recording, network: SensorNetwork, settings: Settings,
                progress: Callable[[int], object] | None = None,
                stopped: Callable[[], bool] | None = None) -> EventsResult:
    """The events of a recording; `progress` and `stopped` are as for `apps.replay.replay`.

    Raises
    ------
    RecordingError
    """
    reader = SampleReader(recording, network)
    calibrate = Calibrate(network, settings.calibrate)
    stage = Events(network, settings.align, settings.detect)
    prescan_of(recording, network, settings.calibrate, stopped).apply(calibrate)
    found: list[PassEvent] = []
    try:
        for readings in until_stopped(reader.readings, progress, stopped):
            for calibrated in calibrate.feed(readings):
                found += stage.feed(calibrated)
    except ReadingStopped:
        pass
    for calibrated in calibrate.flush():
        found += stage.feed(calibrated)
    found += stage.flush()
    return EventsResult(tuple(found), dict(reader.rejected + Counter(rejected(calibrate.counts))),
                        tuple(calibrate.unready()), tuple(reader.missing_topics()))
