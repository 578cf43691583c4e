"""Report of fitted passes: map with time slider, fields, model orders."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.analysis.fitted_pass import FittedPass
from mag_tracking.analysis.pass_result import MAX_NORMALISED_COST, PassFit
from mag_tracking.files import replace_text
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.report.fit_figures import target_alone
from mag_tracking.report.page import NOTE, REPORT, WARNING, Chart, Note, Page, Table, report_html
from mag_tracking.report.page_charts import axes, curve
from mag_tracking.report.page_scene import field_entry, fitted_entry, scene_of
from mag_tracking.report.road import Road, road_of
from mag_tracking.units import NS

RECORDING_GAP_S = 5.0
"""Gap between two recordings on the time axis of the page [s]."""
N_POSES = 120
"""Number of poses shown per pass."""


def write_report(passes: Sequence[FittedPass], network: SensorNetwork, warnings: Sequence[str],
                 out: Path) -> Path:
    """Write the report of fitted passes, with `RecordingFit.warnings`, to `report.html`."""
    path = out / REPORT
    replace_text(path, report_html(fit_page(passes, network, warnings)))
    return path


def fit_page(passes: Sequence[FittedPass], network: SensorNetwork,
             warnings: Sequence[str]) -> Page:
    """Create the page of fitted passes; those without an estimate are not on the map."""
    notes = [Note(WARNING, text) for text in (*warnings, *_poor_fits(passes))]
    if not passes:
        notes.append(Note(NOTE, 'no passes: nothing was detected'))
    if any(fitted.n_vehicles > 1 for fitted in passes):
        notes.append(Note(NOTE, 'for vehicles that were fitted together, the fitted field of the '
                          'other vehicles is subtracted from the measured field'))
    peak_times = [ns / NS for ns in _peaks_ns(passes)]
    if len({fitted.recording for fitted in passes}) > 1:
        notes.append(Note(NOTE, 'the time axis shows the recordings one after another'))
    tracks = [_pass_entry(k + 1, fitted, fitted.chosen, peak_times[k])
              for k, fitted in enumerate(passes) if fitted.chosen is not None]
    end_times = [peak_times[k] + float(fitted.fits[0].data.t.max())
                 for k, fitted in enumerate(passes)]
    scene = scene_of(network, 0, int(max(end_times) * NS), tracks, _road(passes, network)) \
        if tracks else None
    n_estimates = len(tracks)
    n_passes = len({(fitted.recording, fitted.number) for fitted in passes})
    vehicles_text = f', {quantity(len(passes), "vehicle")}' if len(passes) > n_passes else ''
    return Page(f'{quantity(n_passes, "pass", "passes")}{vehicles_text}, '
                f'{n_estimates} with an estimate',
                'each fitted as a row of dipoles at constant velocity', notes, scene,
                [_order_chart(passes)] if passes else [], [_table(passes)])


def _poor_fits(passes: Sequence[FittedPass]) -> list[str]:
    """Return one warning if chosen fits have a high normalised cost, otherwise an empty list."""
    costs = [fitted.chosen.normalised_cost for fitted in passes if fitted.chosen is not None]
    n_poor = sum(cost > MAX_NORMALISED_COST for cost in costs)
    if not n_poor:
        return []
    return [f'poor fits (normalised cost above {MAX_NORMALISED_COST:g}): {n_poor} of {len(costs)}; '
            'errors in speed and position may exceed several standard deviations']


def _peaks_ns(passes: Sequence[FittedPass]) -> list[int]:
    """Return the time [ns] of the strongest field of each pass, on the time axis of the page."""
    peaks: list[int] = []
    recording, shift, end = '', 0, 0
    for fitted in passes:
        data = fitted.fits[0].data
        if fitted.recording != recording:
            recording = fitted.recording
            first = data.stamp_ns + int(NS * data.t.min())
            shift = end + (int(RECORDING_GAP_S * NS) if peaks else 0) - first
        peaks.append(data.stamp_ns + shift)
        end = peaks[-1] + int(NS * data.t.max())
    return peaks


def _pass_entry(number: int, fitted: FittedPass, fit: PassFit, peak_time: float) -> dict[str, Any]:
    """Create the scene entry of a chosen fit; the field is strongest at `peak_time` [s]."""
    data = fit.data
    t = np.linspace(data.t.min(), data.t.max(), N_POSES)
    F = np.tile(np.eye(6), (N_POSES, 1, 1))
    F[:, :3, 3:] = t[:, None, None] * np.eye(3)
    state = F @ fit.x[:6]
    C = F @ fit.robust_covariance[:6, :6] @ F.transpose(0, 2, 1)
    C[:, :3, :3] += fit.position_covariance - fit.robust_covariance[:3, :3]
    target_field = target_alone(fit)
    other_field = fit.predicted - target_field
    fields = [field_entry(int(j), (data.field - other_field)[data.sensor == j],
                          target_field[data.sensor == j], peak_time + data.t[data.sensor == j])
              for j in data.sensors]
    entry = fitted_entry(number, peak_time + t, state, C, fit.ambiguous, float(fit.length[0]),
                         fields)
    entry['facts'] = {
        'label': f'{fitted.recording}, {fitted.label}', 'kind': quantity(fit.n_dipoles, 'dipole'),
        'speed': float(fit.speed[0]), 'moment': float(np.linalg.norm(fit.moment[0])),
        'verdict': ('ambiguous' if fit.ambiguous else 'unique')
        + f', cost {fit.normalised_cost:.2f}'}
    return entry


def _road(passes: Sequence[FittedPass], network: SensorNetwork) -> Road:
    """Road along the unambiguous fits."""
    fits = [fitted.chosen for fitted in passes if fitted.chosen is not None]
    return road_of(network.positions[:, :2], [
        fit.x[:2] + np.outer(np.linspace(fit.data.t.min(), fit.data.t.max(), N_POSES), fit.x[3:5])
        for fit in fits if not fit.ambiguous])


def _order_chart(passes: Sequence[FittedPass]) -> Chart:
    """Chart of the normalised cost against the number of dipoles."""
    traces = []
    for k, fitted in enumerate(passes):
        fits = [f for f in fitted.fits if len(f.x)]
        traces.append(curve([f.n_dipoles for f in fits], [f.normalised_cost for f in fits],
                            f'{fitted.recording}, {fitted.label}', k, 'lines+markers'))
    layout = axes('number of dipoles', 'normalised cost (1 = consistent with noise)', log_y=True)
    layout['xaxis']['dtick'] = 1
    return Chart('Quality of the fits by number of dipoles', traces, layout)


def _table(passes: Sequence[FittedPass]) -> Table:
    """Table with one row per fitted vehicle and number of dipoles."""
    rows: list[list[str | float | None]] = []
    for fitted in passes:
        for fit in fitted.fits:
            row: list[str | float | None] = [fitted.recording, fitted.label.removeprefix('pass '),
                                             fit.n_dipoles]
            has_estimate = bool(len(fit.x)) and not fit.reason
            row += [float(fit.normalised_cost) if len(fit.x) else None]
            row += [*map(float, fit.position), float(fit.speed[0]),
                    float(np.degrees(fit.heading[0])), float(fit.length[0]),
                    float(np.linalg.norm(fit.moment[0]))] if has_estimate else [None] * 7
            row += ['chosen' if fit is fitted.chosen else fit.reason]
            rows.append(row)
    return Table('All fits', ['recording', 'pass', 'dipoles', 'cost', 'x [m]', 'y [m]', 'z [m]',
                              'speed [m/s]', 'heading [deg]', 'length [m]', 'moment [A m²]', ''],
                 rows)
