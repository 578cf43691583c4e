"""Figures and report of the calibration of a network, of tumbled sensors and of a board."""

from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from mag_tracking.apps.calibrate import Calibration, GeometrySurvey, sensor_rows
from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit
from mag_tracking.geometry import yaw_between
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.report import page, style

MAX_KNOCKS = 8
"""Maximum number of sensors in the charts of knocks."""
KNOCK_START, KNOCK_MARGIN_S = 0.3, 0.25
"""Acceleration at which a knock starts, relative to the maximum of the sensor, and time shown
before and after it [s]."""
MAX_NAMES = 60
"""Maximum number of sensor names on an axis. In a larger network, only every second, third, ...
name is drawn."""
SUSPECT_COLOUR = 'tab:red'
Curve: TypeAlias = tuple[str, FloatArray, FloatArray]


def write_report(calibration: Calibration, nominal: SensorNetwork, name: str, path: Path) -> None:
    """Write the report of a calibration of the network `nominal` from the recording `name`."""
    survey = calibration.survey
    severity = page.ERROR if survey.disagreements else page.WARNING
    notes = [page.Note(severity, text) for text in survey.warnings()]
    notes += [page.Note(page.WARNING, f'{sensor}: no background was learnt')
              for sensor in calibration.without_background]
    notes += [page.Note(page.WARNING, f'{cause}: {n}') for cause, n in calibration.rejected.items()]
    if calibration.evidence is not None:
        passes = quantity(calibration.evidence.n_tracks, 'pass', 'passes')
        notes.append(page.Note(page.NOTE, f'{passes} used'))
    page.Page(f'Calibration from {name}', quantity(len(nominal), 'sensor'), notes, None,
              [*_charts(calibration, nominal)], [_table(calibration)]).write(path)


def _knocks(calibration: Calibration) -> list[tuple[str, list[Curve]]]:
    """First knock by uncorrected and by corrected clocks: (title, [(sensor, s, m/s²)])."""
    shocks = dict(list(calibration.survey.shocks.items())[:MAX_KNOCKS])
    first = min((float(t[s > KNOCK_START * s.max()][0]) for t, s in shocks.values()
                 if len(s) and s.max() > 0.0), default=0.0)
    network, out = calibration.network, []
    for title, is_corrected in (('uncorrected clocks', False), ('corrected clocks', True)):
        curves = []
        for name, (t, acceleration) in shocks.items():
            offset = network.clock_offset[network.index(name)] if is_corrected else 0.0
            is_near = np.abs(t - offset - first) < KNOCK_MARGIN_S
            curves.append((name, t[is_near] - offset - first, acceleration[is_near]))
        out.append((title, curves))
    return out


def _rotations(calibration: Calibration, nominal: SensorNetwork,
               ) -> list[tuple[str, list[float], list[float]]]:
    """Rotation of each sensor about the vertical relative to the network file, and half width of
    its 90 % interval [deg], by step of the calibration."""
    steps = [('compass', calibration.survey.network)]
    if calibration.evidence is not None:
        steps.append(('compass and passes', calibration.network))
    return [(label, [float(np.degrees(yaw_between(*R)))
                     for R in zip(nominal.R_ws, network.R_ws, strict=True)],
             [0.0 if s is None else style.SCALE_1D * float(np.degrees(s[2]))
              for s in network.orientation_std]) for label, network in steps]


def _charts(calibration: Calibration, nominal: SensorNetwork) -> Iterator[page.Chart]:
    for title, curves in _knocks(calibration):
        if curves:
            yield page.Chart(
                f'First knock, {title}', [page.curve(t, a, name, k, 'lines+markers')
                                          for k, (name, t, a) in enumerate(curves)],
                page.axes('time [s]', 'acceleration relative to rest [m/s²]'))
    names = [escape(name, quote=False) for name in nominal.names]
    yield page.Chart('Rotation about the vertical relative to the network file, 90% intervals', [
        {'type': 'scatter', 'mode': 'markers', 'x': yaw, 'y': names, 'name': label,
         'showlegend': True,
         'error_x': {'type': 'data', 'array': half_width, 'color': style.SERIES_COLOURS[k]},
         'marker': {'color': style.SERIES_COLOURS[k], 'size': 8, 'symbol': ('circle', 'square')[k]}}
        for k, (label, yaw, half_width) in enumerate(_rotations(calibration, nominal))],
        page.axes('[degrees]', ''))


def _table(calibration: Calibration) -> page.Table:
    return page.Table(
        'Sensors', ['sensor', 'tilt [deg]', 'heading [deg]', 'std [deg]', 'clock [ms]', 'std [ms]',
                    'noise [nT]', 'source'],
        [[name, *angles, 1e3 * clock, 1e3 * clock_std,
          None if noise is None else 1e9 * float(np.nanmean(noise)), source]
         for name, *angles, clock, clock_std, noise, source in sensor_rows(calibration.network)])


def calibration_figure(calibration: Calibration, nominal: SensorNetwork) -> Figure:
    """Plot the knocks before and after the clock correction, and the yaw relative to `nominal`."""
    figure = Figure(figsize=(11.0, 4.6), layout='constrained')
    *left, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    for axes, (title, curves) in zip(left, _knocks(calibration), strict=True):
        for k, (name, t, acceleration) in enumerate(curves):
            axes.plot(t, acceleration, '.-', ms=4, lw=0.8, color=f'C{k}', label=style.literal(name))
        axes.set_title(f'knock, {title}', fontsize=10)
        axes.set_xlabel('time [s]')
    left[0].set_ylabel('acceleration relative to rest [m/s²]')
    if curves:
        left[1].legend(fontsize=8)
    for k, (label, yaw, half_width) in enumerate(_rotations(calibration, nominal)):
        right.errorbar(yaw, np.arange(len(yaw)) + (0.12, -0.12)[k], xerr=half_width, fmt='o', ms=4,
                       capsize=3, color=('tab:orange', 'tab:blue')[k], label=label)
    right.axvline(0.0, color='k', lw=0.8, ls=':', label='network file')
    right.set_yticks(range(len(nominal)), [style.literal(name) for name in nominal.names])
    right.invert_yaxis()
    right.set_title('rotation about the vertical (90 %)', fontsize=10)
    right.set_xlabel('rotation [degrees]')
    right.legend(fontsize=8)
    for axes in (*left, right):
        axes.grid(alpha=0.3)
    return figure


def tumble_figure(fits: Mapping[str, EllipsoidFit], readings: Mapping[str, FloatArray]) -> Figure:
    """Plot magnitudes before and after correction of `readings` (n, 3), and field directions."""
    figure = Figure(figsize=(10.0, 0.6 + 2.7 * len(fits)), layout='constrained')
    rows = figure.subplots(len(fits), 2, squeeze=False, width_ratios=(1.5, 1.0))
    for (left, right), (name, fit) in zip(rows, fits.items(), strict=True):
        y = readings[name][~np.isnan(readings[name]).any(axis=1)]
        B = fit.correct(y)
        for values, colour, label in ((y, 'tab:orange', 'raw data'), (B, 'tab:blue', 'corrected')):
            magnitude = np.linalg.norm(values, axis=1)
            left.plot(magnitude / magnitude.mean(), '.', ms=2, color=colour, rasterized=True,
                      label=f'{label}: std {100 * magnitude.std() / magnitude.mean():.2f} %')
        left.set_title(style.literal(name), fontsize=9)
        left.set(xlabel='reading', ylabel='field magnitude\nrelative to its mean')
        left.legend(fontsize=8, loc='upper right')
        u = B / np.linalg.norm(B, axis=1, keepdims=True)
        right.plot(np.degrees(np.arctan2(u[:, 1], u[:, 0])), u[:, 2], '.', ms=2,
                   color='tab:blue', rasterized=True)
        right.set(xlim=(-180.0, 180.0), ylim=(-1.0, 1.0), xlabel='azimuth of the field [degrees]',
                  ylabel='z component')
        right.set_title(f'directions (equal-area), coverage {fit.coverage:.2f}', fontsize=9)
        for axes in (left, right):
            axes.grid(alpha=0.3)
    return figure


def geometry_figure(survey: GeometrySurvey) -> Figure:
    """Plot the corrections of the sensor positions, orientations and gains, and the residuals."""
    g, names = survey.geometry, survey.network.names
    indices, suspect = np.arange(len(names)), np.isin(names, g.suspect_sensors)
    figure = Figure(figsize=(15.0, 9.5), layout='constrained')
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.15))
    board, poses = left.subplots(2, 1, height_ratios=(2.4, 1.0))
    _plot_displacements(left, board, survey, suspect)
    _plot_pose_residuals(poses, survey)
    shift, rotation, gain, residual = right.subplots(4, 1, sharex=True)
    displacement = np.linalg.norm(survey.network.positions - survey.nominal.positions, axis=1)
    for axes, title, magnitude, std in (
            (shift, 'displacement [mm]', 1e3 * displacement, 1e3 * g.position_std),
            (rotation, 'rotation [deg]', np.rad2deg(survey.rotation_angle),
             np.rad2deg(g.rotation_std))):
        axes.bar(indices, style.SCALE_1D * np.sqrt(np.square(std).mean(axis=1)), color='0.85',
                 width=0.8, label='uncertainty (90 %, per axis)')
        axes.plot(indices, magnitude, 'o', ms=4, color='tab:blue', label='correction')
        axes.set_title(title, fontsize=10, loc='left')
        axes.legend(fontsize=7, ncols=2, loc='lower right', bbox_to_anchor=(1.0, 1.0),
                    frameon=False)
        axes.grid(alpha=0.3)
    gain.errorbar(indices, g.gain, yerr=style.SCALE_1D * g.gain_std, fmt='o', ms=4, capsize=2,
                  color='tab:blue')
    _mark_one(gain, 'gain (90 %)')
    residual.bar(indices, np.nan_to_num(g.sensor_residual), width=0.8,
                 color=np.where(suspect, SUSPECT_COLOUR, 'tab:blue').tolist())
    _mark_one(residual,
              'residual in standard deviations (RMS; 1 for correct noise and field error)')
    residual.grid(alpha=0.3)
    step = -(-len(names) // MAX_NAMES)
    residual.set_xticks(indices[::step], [style.literal(name) for name in names[::step]],
                        rotation=90, fontsize=7)
    residual.set_xlim(-0.7, len(names) - 0.3)
    return figure


def _mark_one(axes: Axes, title: str) -> None:
    """Set the title, and draw a line at 1, the expected value."""
    axes.axhline(1.0, color='k', lw=0.8, ls=':')
    axes.set_title(title, fontsize=10, loc='left')


def _plot_displacements(figure: SubFigure, axes: Axes, survey: GeometrySurvey,
                        suspect: BoolArray) -> None:
    """Plot the board, viewed along its thinnest axis, with magnified arrows for displacements."""
    positions = survey.nominal.positions
    c, *widest = np.argsort(np.ptp(positions, axis=0), kind='stable').tolist()
    a, b = sorted(widest)
    shift = 1e3 * (survey.network.positions - positions)
    extent = np.ptp(positions, axis=0).max() or 1.0
    longest = np.linalg.norm(shift[:, [a, b]], axis=1).max()
    key = 1.0
    if longest > 0.0:
        # The longest arrow, rounded down to 1, 2 or 5 times a power of ten.
        power = 10.0 ** np.floor(np.log10(longest))
        key = power * max(m for m in (1.0, 2.0, 5.0) if m * power <= longest * (1.0 + 1e-9))
    r, _ = survey.geometry.poses
    axes.plot(r[:, a], r[:, b], '.', ms=3, color='0.85', zorder=0, label='poses of the magnet')
    max_shift = np.abs(shift[:, c]).max() or 1.0
    arrows = axes.quiver(
        positions[:, a], positions[:, b], shift[:, a], shift[:, b], shift[:, c], cmap='coolwarm',
        clim=(-max_shift, max_shift), angles='xy', scale_units='xy', width=0.006, edgecolor='k',
        linewidth=0.4, scale=8.0 * (longest or 1.0) / extent, zorder=2)
    axes.quiverkey(arrows, 0.86, 1.03, key, f'{key:g} mm', labelpos='E')
    axes.plot(positions[:, a], positions[:, b], 'k.', ms=3, zorder=3, label='nominal positions')
    if suspect.any():
        axes.plot(positions[suspect, a], positions[suspect, b], 'o', ms=12, mfc='none', mew=1.5,
                  color=SUSPECT_COLOUR, label='suspect sensor')
    if len(positions) <= MAX_NAMES:
        for name, position in zip(survey.network.names, positions, strict=True):
            axes.annotate(style.literal(name), position[[a, b]], xytext=(3, -8),
                          textcoords='offset points', fontsize=6, color='0.35')
    # A few distant poses must not extend the axes.
    low, high = positions.min(axis=0) - 0.15 * extent, positions.max(axis=0) + 0.15 * extent
    axes.set(xlim=(low[a], high[a]), ylim=(low[b], high[b]), aspect='equal',
             xlabel=f'{"xyz"[a]} [m]', ylabel=f'{"xyz"[b]} [m]')
    axes.set_title('displacement from the nominal positions', fontsize=10, loc='left')
    axes.legend(fontsize=7, ncols=3, loc='upper center', bbox_to_anchor=(0.5, -0.12),
                frameon=False)
    figure.colorbar(arrows, ax=axes, shrink=0.7, label=f'displacement along {"xyz"[c]} [mm]')


def _plot_pose_residuals(axes: Axes, survey: GeometrySurvey) -> None:
    suspect = np.isin(survey.rows, survey.suspect_rows)
    residual = survey.geometry.pose_residual
    axes.plot(survey.rows[~suspect], residual[~suspect], '.', ms=4, color='tab:blue')
    axes.plot(survey.rows[suspect], residual[suspect], 'o', ms=5, color=SUSPECT_COLOUR)
    axes.set_ylim(0.0)
    _mark_one(axes, 'residual of the poses, relative to the noise'
              + (f'; suspect: {suspect.sum()} (red)' if suspect.any() else ''))
    axes.grid(alpha=0.3)
    axes.set_xlabel('row of the table')
