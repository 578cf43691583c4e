"""Figures and report of fitted passes: fields, model orders, map with time slider."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mag_tracking.analysis.fitted_pass import FittedPass
from mag_tracking.analysis.pass_result import MAX_NORMALISED_COST, PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.report import page, style
from mag_tracking.report.page_scene import field_entry, pose_entry, scene_of
from mag_tracking.report.road import road_of
from mag_tracking.units import NS

MAX_SENSORS = 6
RECORDING_GAP_S = 5.0
"""Gap between two recordings on the time axis of the page [s]."""
N_POSES = 120


def pass_figure(fit: PassFit, title: str) -> Figure:
    """Plot the measured and the fitted field, with 90 % bands, as [TSP14]_ Fig. 6.

    The bands account for the noise and for the uncertainty of the parameters; a normalised cost
    above 1 scales the noise variance. The `MAX_SENSORS` with the strongest fields are plotted.
    """
    data = fit.data
    background = fit.predicted - _target_field(fit)
    strength = {j: np.nanmax(np.abs(data.field - background)[data.sensor == j])
                for j in data.sensors}
    strongest = sorted(sorted(strength, key=lambda j: -strength[j])[:MAX_SENSORS])
    f, unit = style.field_unit(max(strength.values()))
    factor = max(1.0, fit.normalised_cost)
    figure = Figure(figsize=(10.0, 1.0 + 2.6 * len(strongest)), layout='constrained')
    for axes, j in zip(figure.subplots(len(strongest), 1, squeeze=False, sharex=True).flat,
                       strongest, strict=True):
        rows = data.sensor == j
        t = data.t[rows]
        # At rest, a coarse sensor has an enlarged covariance, so that all its readings count as one
        # reading. The minimum excludes these covariances.
        noise = np.nanmin(np.einsum('nii->ni', data.covariance[rows]), axis=0, initial=np.inf)
        for a, colour in enumerate(style.AXIS_COLOURS):
            if np.isnan(data.field[rows, a]).all():
                continue
            middle = f * (fit.predicted - background)[rows, a]
            half = f * style.SCALE_1D * np.sqrt(fit.predicted_std[rows, a]**2 + factor * noise[a])
            axes.fill_between(t, middle - half, middle + half, color=colour, alpha=0.25, lw=0)
            axes.plot(t, f * (data.field - background)[rows, a], '.', ms=2.5, color=colour,
                      label=f'{"xyz"[a]}')
            axes.plot(t, middle, '-', lw=0.9, color='k')
        axes.set_title(style.literal(data.network.names[j]), fontsize=9)
        axes.set_ylabel(f'field [{unit}]')
        axes.grid(alpha=0.3)
        style.legend_beside(axes)
    axes.set_xlabel('time relative to the strongest field [s]')
    figure.suptitle(f'{style.literal(title)}: measured (dots), fitted (lines), 90 % bands',
                    fontsize=11)
    return figure


def _target_field(fit: PassFit) -> FloatArray:
    """Fitted field (n, 3) [T] of the target, without the fitted background of each sensor."""
    out = fit.predicted.copy()
    for name, value in zip(fit.names, fit.x, strict=True):
        if name.startswith('B '):
            sensor, axis = name[2:].rsplit(' ', 1)
            out[fit.data.sensor == fit.data.network.index(sensor), 'xyz'.index(axis)] -= value
    return out


def order_figure(passes: Sequence[FittedPass]) -> Figure:
    """Plot the normalised cost by number of dipoles, as [TSP14]_ Fig. 7; the chosen is filled."""
    figure = Figure(figsize=(7.5, 5.0), layout='constrained')
    axes = figure.add_subplot()
    for k, one in enumerate(passes):
        fits = [f for f in one.fits if len(f.x)]
        if not fits:
            continue
        colour = style.series_colour(k)
        axes.semilogy([f.n_dipoles for f in fits], [f.normalised_cost for f in fits], 'o-',
                      mfc='w', color=colour, label=style.literal(f'{one.recording}, {one.label}'))
        if one.chosen is not None:
            axes.semilogy([one.chosen.n_dipoles], [one.chosen.normalised_cost], 'o', ms=8,
                          color=colour)
    axes.axhline(1.0, color='k', lw=0.8, ls='--')
    axes.set(xticks=sorted({f.n_dipoles for one in passes for f in one.fits}),
             xlabel='number of dipoles',
             ylabel='normalised cost (1 if the residuals match the noise)')
    axes.grid(alpha=0.3, which='both')
    style.legend_beside(axes)
    style.plain_log_ticks(axes)
    figure.suptitle('Fit of a row of dipoles to each pass (filled: chosen order)', fontsize=11)
    return figure


def fit_page(passes: Sequence[FittedPass], network: SensorNetwork,
             warnings: Sequence[str]) -> page.Page:
    """Create the page of fitted passes; those without an estimate are not on the map."""
    chosen = [fitted.chosen for fitted in passes if fitted.chosen is not None]
    n_poor = sum(fit.normalised_cost > MAX_NORMALISED_COST for fit in chosen)
    texts = [*warnings]
    if n_poor:
        texts.append(f'poor fits (normalised cost above {MAX_NORMALISED_COST:g}): {n_poor} of '
                     f'{len(chosen)}; errors in speed and position may exceed several standard '
                     'deviations')
    notes = [page.Note(page.WARNING, text) for text in texts]
    if not passes:
        notes.append(page.Note(page.NOTE, 'no passes: nothing was detected'))
    if any(fitted.n_vehicles > 1 for fitted in passes):
        notes.append(page.Note(page.NOTE, 'for vehicles that were fitted together, the fitted '
                               'field of the other vehicles is subtracted from the measured field'))
    peak_times = [ns / NS for ns in _peaks_ns(passes)]
    if len({fitted.recording for fitted in passes}) > 1:
        notes.append(page.Note(page.NOTE, 'the time axis shows the recordings one after another'))
    tracks = [_pass_entry(k + 1, fitted, fitted.chosen, peak_times[k])
              for k, fitted in enumerate(passes) if fitted.chosen is not None]
    scene = None
    if tracks:
        end = max(peak + float(fitted.fits[0].data.t.max())
                  for peak, fitted in zip(peak_times, passes, strict=True))
        # The road is along the unambiguous fits.
        road = road_of(network.positions[:, :2], [
            fit.x[:2] + np.outer(_times(fit), fit.x[3:5]) for fit in chosen if not fit.ambiguous])
        scene = scene_of(network, 0, int(end * NS), tracks, road)
    n_passes = len({(fitted.recording, fitted.number) for fitted in passes})
    vehicles_text = f', {quantity(len(passes), "vehicle")}' if len(passes) > n_passes else ''
    return page.Page(f'{quantity(n_passes, "pass", "passes")}{vehicles_text}, '
                f'{len(tracks)} with an estimate',
                'each fitted as a row of dipoles at constant velocity', notes, scene,
                [_order_chart(passes)] if passes else [], [_table(passes)])


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


def _times(fit: PassFit) -> FloatArray:
    return np.linspace(fit.data.t.min(), fit.data.t.max(), N_POSES)


def _pass_entry(number: int, fitted: FittedPass, fit: PassFit, peak_time: float) -> dict[str, Any]:
    """Create the scene entry of a chosen fit; the field is strongest at `peak_time` [s]."""
    data, t = fit.data, _times(fit)
    F = np.tile(np.eye(6), (N_POSES, 1, 1))
    F[:, :3, 3:] = t[:, None, None] * np.eye(3)
    state = F @ fit.x[:6]
    C = F @ fit.robust_covariance[:6, :6] @ F.transpose(0, 2, 1)
    C[:, :3, :3] += fit.position_covariance - fit.robust_covariance[:3, :3]
    missing = np.full((N_POSES, 3), np.nan)
    entry = pose_entry(number, peak_time + t, state, C, np.full(N_POSES, fit.ambiguous),
                       np.full(N_POSES, float(fit.length[0])), missing, missing[:, 0],
                       np.zeros(N_POSES))
    target_field = _target_field(fit)
    other_field = fit.predicted - target_field
    entry['fields'] = [
        field_entry(int(j), (data.field - other_field)[data.sensor == j],
                    target_field[data.sensor == j], peak_time + data.t[data.sensor == j])
        for j in data.sensors]
    entry['facts'] = {
        'label': f'{fitted.recording}, {fitted.label}', 'kind': quantity(fit.n_dipoles, 'dipole'),
        'speed': float(fit.speed[0]), 'moment': float(np.linalg.norm(fit.moment[0])),
        'verdict': ('ambiguous' if fit.ambiguous else 'unique')
        + f', cost {fit.normalised_cost:.2f}'}
    return entry


def _order_chart(passes: Sequence[FittedPass]) -> page.Chart:
    traces = []
    for k, fitted in enumerate(passes):
        fits = [f for f in fitted.fits if len(f.x)]
        traces.append(page.curve([f.n_dipoles for f in fits], [f.normalised_cost for f in fits],
                            f'{fitted.recording}, {fitted.label}', k, 'lines+markers'))
    layout = page.axes('number of dipoles', 'normalised cost (1 = consistent with noise)',
                         log_y=True)
    layout['xaxis']['dtick'] = 1
    return page.Chart('Quality of the fits by number of dipoles', traces, layout)


def _table(passes: Sequence[FittedPass]) -> page.Table:
    """Table with one row per fitted vehicle and number of dipoles."""
    rows: list[list[str | float | None]] = []
    for fitted in passes:
        for fit in fitted.fits:
            estimate = [*fit.position, fit.speed[0], np.degrees(fit.heading[0]), fit.length[0],
                        np.linalg.norm(fit.moment[0])] if len(fit.x) and not fit.reason else []
            rows.append([fitted.recording, fitted.label.removeprefix('pass '), fit.n_dipoles,
                         float(fit.normalised_cost) if len(fit.x) else None,
                         *(map(float, estimate) if estimate else [None] * 7),
                         'chosen' if fit is fitted.chosen else fit.reason])
    return page.Table(
        'All fits', ['recording', 'pass', 'dipoles', 'cost', 'x [m]', 'y [m]', 'z [m]',
                     'speed [m/s]', 'heading [deg]', 'length [m]', 'moment [A m²]', ''], rows)
