"""Table `events` of `mag-tracking replay`: passes at each sensor, without tracking."""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from mag_tracking.apps.events import EventSink
from mag_tracking.cli.vehicle_rows import time_of
from mag_tracking.event_records import PassEvent
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline
from mag_tracking.quantities import quantity
from mag_tracking.results.traffic_tables import write_events
from mag_tracking.run import RunReport
from mag_tracking.stages.events.stage import MAX_DURATION_S
from mag_tracking.units import NS


class Events:
    """Events of each recording, written to the folder of the recording."""

    upto = 'calibrate'
    """Last stage of the pipeline that the table needs."""

    def __init__(self, args: argparse.Namespace, network: SensorNetwork,
                 stopped: Callable[[], bool], stack: ExitStack) -> None:
        self._names = network.names

    def sink(self, name: str, pipeline: Pipeline) -> EventSink:
        """Return the sink of a recording."""
        self._sink = EventSink(pipeline)
        return self._sink

    def finish(self, name: str, report: RunReport, out: Path | None) -> None:
        """Print one line per event and the number of events of each sensor; write the tables."""
        result = self._sink.result(report)
        for event in result.events:
            print(line_of(event))
        counts = result.counts()
        print(', '.join(f'{name}: {quantity(counts.get(name, 0), "event")}'
                        for name in self._names))
        if out is not None:
            write_events(out, result.events)


def line_of(event: PassEvent) -> str:
    """Describe an event in one line."""
    p = event.left_to_right
    direction = f'left to right ({p:.0%})' if p > 0.9 else f'right to left ({1.0 - p:.0%})' \
        if p < 0.1 else 'direction unknown'
    duration = (event.release_ns - event.onset_ns) / NS
    time = time_of(event.closest_ns)
    closest = f'closest {time} ± {event.closest_std:.2f} s' if np.isfinite(event.closest_std) \
        else f'peak at {time}, closest point unknown'
    if duration > MAX_DURATION_S:
        closest = f'from {time_of(event.onset_ns)} to {time_of(event.release_ns)}'
    return (f'{event.sensor} {event.number}: {closest}, duration {duration:.2f} s, peak '
            f'{1e9 * np.sqrt(np.nansum(event.peak**2)):.0f} nT on {event.axes}, {direction}'
            + ('' if event.ended else ', not ended'))
