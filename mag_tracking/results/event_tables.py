"""Pass events as CSV tables."""

import csv
from collections.abc import Iterable
from os import PathLike

import numpy as np

from mag_tracking.errors import OutputError
from mag_tracking.event_records import SIGNATURE_SPAN, PassEvent
from mag_tracking.files import new_text_file, output_folder
from mag_tracking.units import NS

EVENT_COLUMNS = ('sensor', 'number', 'ended', 'onset_ns', 'release_ns', 'peak_ns', 'peak_x_nt',
                 'peak_y_nt', 'peak_z_nt', 'energy_nt2_s', 'axes', 'closest_ns', 'sd_closest_s',
                 'time_scale_s', 'left_to_right')
SIGNATURE_COLUMNS = ('sensor', 'number', 'time_s', 'x_nt', 'y_nt', 'z_nt')


def event_row(event: PassEvent) -> list[object]:
    """Values of `EVENT_COLUMNS` for an event."""
    return [event.sensor, event.number, event.ended, event.onset_ns, event.release_ns,
            event.peak_ns, *(_number(1e9 * v) for v in event.peak), _number(1e18 * event.energy),
            event.axes, event.closest_ns, _number(event.closest_std), _number(event.time_scale),
            round(event.left_to_right, 4)]


def _number(value: float) -> str:
    """Format a number with six significant digits; return '' for NaN and infinity."""
    return f'{value:.6g}' if np.isfinite(value) else ''


def write_events(folder: str | PathLike[str], events: Iterable[PassEvent]) -> None:
    """Write `events.csv` and `signatures.csv` to a folder."""
    folder, events = output_folder(folder), list(events)
    try:
        with new_text_file(folder / 'events.csv', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow(EVENT_COLUMNS)
            writer.writerows(map(event_row, events))
        with new_text_file(folder / 'signatures.csv', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow(SIGNATURE_COLUMNS)
            for event in events:
                offsets_s = event.time_scale * np.linspace(-SIGNATURE_SPAN, SIGNATURE_SPAN,
                                                           len(event.signature))
                closest_s = (event.closest_ns - event.onset_ns) / NS
                writer.writerows([event.sensor, event.number, _number(closest_s + t),
                                  *(_number(1e9 * v) for v in field)]
                                 for t, field in zip(offsets_s, event.signature, strict=True))
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror}') from error
