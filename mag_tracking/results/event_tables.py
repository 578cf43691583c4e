"""Pass events as CSV tables."""

import csv
from collections.abc import Iterable
from os import PathLike

import numpy as np

from mag_tracking.errors import OutputError
from mag_tracking.event_records import SIGNATURE_SPAN, PassEvent
from mag_tracking.files import new_text_file, output_folder
from mag_tracking.results.columns import EVENTS, SIGNATURES, names_of, row_of
from mag_tracking.units import NS


def event_row(event: PassEvent) -> list[object]:
    """Cells of an event by column; numbers with a unit have six significant digits."""
    row = row_of(EVENTS, event)
    return [_number(row[c.name]) if c.kind == 'f' and c.unit else row[c.name] for c in EVENTS]


def _number(value: float) -> str:
    """Format a number with six significant digits; return '' for NaN and infinity."""
    return f'{value:.6g}' if np.isfinite(value) else ''


def write_events(folder: str | PathLike[str], events: Iterable[PassEvent]) -> None:
    """Write `events.csv` and `signatures.csv` to a folder."""
    folder, events = output_folder(folder), list(events)
    try:
        with new_text_file(folder / 'events.csv', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow(names_of(EVENTS))
            writer.writerows(map(event_row, events))
        with new_text_file(folder / 'signatures.csv', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow(names_of(SIGNATURES))
            for event in events:
                offsets_s = event.time_scale * np.linspace(-SIGNATURE_SPAN, SIGNATURE_SPAN,
                                                           len(event.signature))
                closest_s = (event.closest_ns - event.onset_ns) / NS
                writer.writerows([event.sensor, event.number, _number(closest_s + t),
                                  *(_number(1e9 * v) for v in field)]
                                 for t, field in zip(offsets_s, event.signature, strict=True))
    except OSError as error:
        raise OutputError(f'cannot write to {folder}: {error.strerror}') from error
