"""Report of `mag-tracking doctor`: faults of the sensors and advice."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from mag_tracking.apps.doctor import Doctor
from mag_tracking.quantities import quantity
from mag_tracking.report.page import (
    ERROR,
    NOTE,
    Chart,
    Note,
    Page,
    Table,
    axes_layout,
    write_page,
)
from mag_tracking.report.style import AXIS_COLOURS
from mag_tracking.stages.health.diagnosis import Diagnosis
from mag_tracking.stages.health.sensor_health import MAX_LIVE_DELAY_S


def write_report(doctor: Doctor, diagnoses: Sequence[Diagnosis], subject: str,
                 path: Path) -> None:
    """Write the report of `subject`, a recording or network: diagnoses, noise, sample rates."""
    notes = [Note(ERROR if d.serious else NOTE, str(d))
             for d in diagnoses] or [Note(NOTE, 'no faults found')]
    n_serious = sum(d.serious for d in diagnoses)
    numbers = (f'{quantity(n_serious, "serious finding")}, '
               f'{quantity(len(diagnoses) - n_serious, "note")}')
    write_page(Page(f'Health of {subject}', numbers, notes, None, _charts(doctor),
                    [_table(doctor)]), path)


def _charts(doctor: Doctor) -> list[Chart]:
    """Charts of the noise of each axis and of the sample rates."""
    names = [escape(name, quote=False) for name in doctor.sensors]
    noise = [{'type': 'bar', 'x': names, 'name': letter, 'marker': {
        'color': colour, 'pattern': {'shape': ('', '/', 'x')[axis]}},
        'y': [1e9 * float(h.noise_std[axis]) for h in doctor.sensors.values()]}
        for axis, (letter, colour) in enumerate(zip('xyz', AXIS_COLOURS, strict=True))]
    rates = [float(h.rate) if h.counts['readings'] else 0.0 for h in doctor.sensors.values()]
    return [Chart('Noise per axis', noise, axes_layout('', 'standard deviation [nT]')),
            Chart('Sample rate', [{'type': 'bar', 'x': names, 'y': rates, 'showlegend': False}],
                  axes_layout('', 'rate [Hz]'))]


def _table(doctor: Doctor) -> Table:
    """Table of the readings, faults, field and delay of each sensor."""
    rows: list[list[str | float | None]] = []
    for name, health in doctor.sensors.items():
        c, delay = health.counts, float(health.delay_s[0])
        has_readings = bool(c['readings'])
        rows.append([
            name, c['readings'], float(health.rate) if has_readings else None, c['lost'],
            c['duplicates'], c['spikes'],
            1e6 * float(np.sqrt(np.nansum(health.field**2))) if has_readings else None,
            1e3 * delay if abs(delay) < MAX_LIVE_DELAY_S else None])
    return Table('Sensors', ['sensor', 'readings', 'rate [Hz]', 'lost', 'duplicates', 'spikes',
                             'field [µT]', 'delay [ms]'], rows)
