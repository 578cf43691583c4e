"""Report of `mag-tracking doctor`: faults of the sensors and advice."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from mag_tracking.apps.doctor import Doctor
from mag_tracking.quantities import quantity
from mag_tracking.report import page
from mag_tracking.report.style import AXIS_COLOURS
from mag_tracking.stages.health.diagnosis import Diagnosis
from mag_tracking.stages.health.sensor_health import MAX_LIVE_DELAY_S


def write_report(doctor: Doctor, diagnoses: Sequence[Diagnosis], subject: str,
                 path: Path) -> None:
    """Write the report of `subject`, a recording or network: diagnoses, noise, sample rates."""
    notes = [page.Note(page.ERROR if d.serious else page.NOTE, str(d))
             for d in diagnoses] or [page.Note(page.NOTE, 'no faults found')]
    n_serious = sum(d.serious for d in diagnoses)
    numbers = (f'{quantity(n_serious, "serious finding")}, '
               f'{quantity(len(diagnoses) - n_serious, "note")}')
    page.Page(f'Health of {subject}', numbers, notes, None, _charts(doctor),
              [_table(doctor)]).write(path)


def _charts(doctor: Doctor) -> list[page.Chart]:
    """Charts of the noise of each axis and of the sample rates."""
    names = [escape(name, quote=False) for name in doctor.sensors]
    noise = [{'type': 'bar', 'x': names, 'name': letter, 'marker': {
        'color': colour, 'pattern': {'shape': ('', '/', 'x')[axis]}},
        'y': [1e9 * float(h.noise_std[axis]) for h in doctor.sensors.values()]}
        for axis, (letter, colour) in enumerate(zip('xyz', AXIS_COLOURS, strict=True))]
    rates = [float(h.rate) if h.counts['readings'] else 0.0 for h in doctor.sensors.values()]
    return [page.Chart('Noise per axis', noise, page.axes('', 'standard deviation [nT]')),
            page.Chart('Sample rate', [
                {'type': 'bar', 'x': names, 'y': rates, 'showlegend': False}],
                page.axes('', 'rate [Hz]'))]


def _table(doctor: Doctor) -> page.Table:
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
    return page.Table('Sensors', ['sensor', 'readings', 'rate [Hz]', 'lost', 'duplicates', 'spikes',
                                  'field [µT]', 'delay [ms]'], rows)
