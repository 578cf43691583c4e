"""Report of a calibration: clock offsets, headings, noise and warnings."""

from pathlib import Path

import numpy as np

from mag_tracking.apps.calibrate import Calibration
from mag_tracking.files import replace_text
from mag_tracking.geometry import yaw_between
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.report.calibration_figures import first_knock
from mag_tracking.report.figures import SCALE_1D
from mag_tracking.report.page import ERROR, NOTE, WARNING, Chart, Note, Page, Table, report_html
from mag_tracking.report.page_charts import axes, curve, escape_markup
from mag_tracking.report.palette import SERIES_COLOURS

MAX_KNOCKS = 8
"""Maximum number of sensors in the charts of knocks."""
KNOCK_MARGIN_S = 0.25
"""Time shown before and after a knock [s]."""


def write_report(calibration: Calibration, nominal: SensorNetwork, name: str, path: Path) -> None:
    """Write the report of a calibration of the network `nominal` from the recording `name`."""
    replace_text(path, report_html(calibration_page(calibration, nominal, name)))


def calibration_page(calibration: Calibration, nominal: SensorNetwork, name: str) -> Page:
    """Create the page of a calibration of the network `nominal` from the recording `name`."""
    survey = calibration.survey
    severity = ERROR if survey.disagreements else WARNING
    notes = [Note(severity, text) for text in survey.warnings()]
    notes += [Note(WARNING, f'{sensor}: no background was learnt')
              for sensor in calibration.without_background]
    notes += [Note(WARNING, f'{cause}: {n}') for cause, n in calibration.rejected.items()]
    if calibration.evidence is not None:
        passes = quantity(calibration.evidence.n_tracks, 'pass', 'passes')
        notes.append(Note(NOTE, f'{passes} used'))
    return Page(f'Calibration from {name}', quantity(len(nominal), 'sensor'), notes, None,
                [*_knocks(calibration), _headings(calibration, nominal)], [_table(calibration)])


def _knocks(calibration: Calibration) -> list[Chart]:
    """Charts of the first knock, before and after clock correction."""
    shocks = dict(list(calibration.survey.shocks.items())[:MAX_KNOCKS])
    if not shocks:
        return []
    first, charts = first_knock(shocks), []
    for title, is_corrected in (('First knock, uncorrected clocks', False),
                                ('First knock, corrected clocks', True)):
        traces = []
        for k, (name, (t, acceleration)) in enumerate(shocks.items()):
            offset = calibration.network.clock_offset[calibration.network.index(name)] \
                if is_corrected else 0.0
            is_near = np.abs(t - offset - first) < KNOCK_MARGIN_S
            traces.append(curve(t[is_near] - offset - first, acceleration[is_near], name, k,
                                'lines+markers'))
        charts.append(Chart(title, traces, axes('time [s]',
                                                'acceleration relative to rest [m/s²]')))
    return charts


def _headings(calibration: Calibration, nominal: SensorNetwork) -> Chart:
    """Chart of the rotation of each sensor about the vertical, relative to the network file."""
    steps = [('compass', calibration.survey.network)]
    if calibration.evidence is not None:
        steps.append(('compass and passes', calibration.network))
    traces = []
    for k, (label, network) in enumerate(steps):
        yaw = [float(np.degrees(yaw_between(nominal.R_ws[j], network.R_ws[j])))
               for j in range(len(nominal))]
        half_width = [0.0 if s is None else SCALE_1D * float(np.degrees(s[2]))
                      for s in network.orientation_std]
        traces.append({
            'type': 'scatter', 'mode': 'markers', 'x': yaw, 'name': label, 'showlegend': True,
            'y': [escape_markup(name) for name in nominal.names],
            'error_x': {'type': 'data', 'array': half_width, 'color': SERIES_COLOURS[k]},
            'marker': {'color': SERIES_COLOURS[k], 'size': 8, 'symbol': ('circle', 'square')[k]}})
    return Chart('Rotation about the vertical relative to the network file, 90% intervals', traces,
                 axes('[degrees]', ''))


def _table(calibration: Calibration) -> Table:
    """Table of the orientation, clock offset and noise of each sensor."""
    network, rows = calibration.network, list[list[str | float | None]]()
    for j, name in enumerate(network.names):
        R, std, noise = network.R_ws[j], network.orientation_std[j], network.noise_std[j]
        record = network.calibrated[j]
        has_clock = record is not None and not np.isnan(record.clock_offset_std)
        rows.append([
            name, float(np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0)))),
            float(np.degrees(np.arctan2(R[1, 0], R[0, 0]))),
            None if std is None else float(np.degrees(std[2])),
            1e3 * float(network.clock_offset[j]) if has_clock else None,
            1e3 * record.clock_offset_std if record is not None and has_clock else None,
            None if noise is None else 1e9 * float(np.nanmean(noise)),
            'nominal orientation' if record is None else record.by])
    return Table('Sensors', ['sensor', 'tilt [deg]', 'heading [deg]', 'std [deg]',
                             'clock [ms]', 'std [ms]', 'noise [nT]', 'source'], rows)
