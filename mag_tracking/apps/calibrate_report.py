"""Figures and report of the calibration of a network, of tumbled sensors and of a board."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from mag_tracking.apps.board_geometry import GeometrySurvey
from mag_tracking.apps.calibrate import Calibration
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit
from mag_tracking.geometry import yaw_between
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.report.page import (
    ERROR,
    NOTE,
    WARNING,
    Chart,
    Note,
    Page,
    Table,
    axes_layout,
    curve,
    escape_markup,
    write_page,
)
from mag_tracking.report.style import SCALE_1D, SERIES_COLOURS, literal

MAX_KNOCKS = 8
"""Maximum number of sensors in the charts of knocks."""
KNOCK_MARGIN_S = 0.25
"""Time shown before and after a knock [s]."""
MAX_NAMES = 60
"""Maximum number of sensor names on an axis. In a larger network, only every second, third, ...
name is drawn."""
SUSPECT_COLOUR = 'tab:red'


def write_report(calibration: Calibration, nominal: SensorNetwork, name: str, path: Path) -> None:
    """Write the report of a calibration of the network `nominal` from the recording `name`."""
    survey = calibration.survey
    severity = ERROR if survey.disagreements else WARNING
    notes = [Note(severity, text) for text in survey.warnings()]
    notes += [Note(WARNING, f'{sensor}: no background was learnt')
              for sensor in calibration.without_background]
    notes += [Note(WARNING, f'{cause}: {n}') for cause, n in calibration.rejected.items()]
    if calibration.evidence is not None:
        passes = quantity(calibration.evidence.n_tracks, 'pass', 'passes')
        notes.append(Note(NOTE, f'{passes} used'))
    write_page(Page(
        f'Calibration from {name}', quantity(len(nominal), 'sensor'), notes, None,
        [*_knocks(calibration), _headings(calibration, nominal)], [_table(calibration)]), path)


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
        charts.append(Chart(title, traces, axes_layout('time [s]',
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
                 axes_layout('[degrees]', ''))


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


def first_knock(shocks: Mapping[str, tuple[FloatArray, FloatArray]]) -> float:
    """Time [s] of the first acceleration above 30 % of the maximum of its sensor; 0 if none."""
    return min((float(t[s > 0.3 * s.max()][0]) for t, s in shocks.values()
                if len(s) and s.max() > 0.0), default=0.0)


def calibration_figure(calibration: Calibration, nominal: SensorNetwork,
                       max_sensors: int = 8) -> Figure:
    """Plot the knocks before and after the clock correction, and the yaw of the sensors.

    `nominal` is the network with the orientations of the network file. The knocks of at most
    `max_sensors` sensors are plotted.
    """
    figure = Figure(figsize=(11.0, 4.6), layout='constrained')
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    _plot_knocks(left, middle, calibration, max_sensors)
    _plot_headings(right, calibration, nominal)
    return figure


def _plot_knocks(before: Axes, after: Axes, calibration: Calibration, max_sensors: int) -> None:
    """Plot the acceleration around the first knock, before and after the clock correction."""
    shocks = {name: calibration.survey.shocks[name]
              for name in list(calibration.survey.shocks)[:max_sensors]}
    first = first_knock(shocks)
    for k, (name, (t, s)) in enumerate(shocks.items()):
        offset = calibration.network.clock_offset[calibration.network.index(name)]
        for axes, shift in ((before, 0.0), (after, offset)):
            near = np.abs(t - shift - first) < 0.25
            axes.plot(t[near] - shift - first, s[near], '.-', ms=4, lw=0.8, color=f'C{k}',
                      label=literal(name))
    for axes, title in ((before, 'knock, uncorrected clocks'), (after, 'knock, corrected clocks')):
        axes.set_title(title, fontsize=10)
        axes.set_xlabel('time [s]')
        axes.grid(alpha=0.3)
    before.set_ylabel('acceleration relative to rest [m/s²]')
    if shocks:
        after.legend(fontsize=8)


def _plot_headings(axes: Axes, calibration: Calibration, nominal: SensorNetwork) -> None:
    """Plot the yaw of each sensor relative to its nominal orientation, by calibration step."""
    n = len(nominal)
    steps = [('compass', calibration.survey.network, 'tab:orange', 0.12)]
    if calibration.evidence is not None:
        steps.append(('compass and passes', calibration.network, 'tab:blue', -0.12))
    for label, network, colour, shift in steps:
        yaw = [np.degrees(yaw_between(nominal.R_ws[j], network.R_ws[j])) for j in range(n)]
        std = [0.0 if s is None else SCALE_1D * np.degrees(s[2]) for s in network.orientation_std]
        axes.errorbar(yaw, np.arange(n) + shift, xerr=std, fmt='o', ms=4, capsize=3, color=colour,
                      label=label)
    axes.axvline(0.0, color='k', lw=0.8, ls=':', label='network file')
    axes.set_yticks(range(n), [literal(name) for name in nominal.names])
    axes.invert_yaxis()
    axes.set_title('rotation about the vertical (90 %)', fontsize=10)
    axes.set_xlabel('rotation [degrees]')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def tumble_figure(fits: Mapping[str, EllipsoidFit], readings: Mapping[str, FloatArray]) -> Figure:
    """Plot a tumble calibration: magnitudes before and after correction, and field directions.

    `readings` (n, 3) are chronological.
    """
    figure = Figure(figsize=(10.0, 0.6 + 2.7 * len(fits)), layout='constrained')
    rows = figure.subplots(len(fits), 2, squeeze=False, width_ratios=(1.5, 1.0))
    for (left, right), (name, fit) in zip(rows, fits.items(), strict=True):
        y = readings[name][~np.isnan(readings[name]).any(axis=1)]
        B = fit.correct(y)
        for values, colour, label in ((y, 'tab:orange', 'raw data'), (B, 'tab:blue', 'corrected')):
            magnitude = np.linalg.norm(values, axis=1)
            left.plot(magnitude / magnitude.mean(), '.', ms=2, color=colour, rasterized=True,
                      label=f'{label}: std {100 * magnitude.std() / magnitude.mean():.2f} %')
        left.set_title(literal(name), fontsize=9)
        left.set_xlabel('reading')
        left.set_ylabel('field magnitude\nrelative to its mean')
        left.legend(fontsize=8, loc='upper right')
        u = B / np.linalg.norm(B, axis=1, keepdims=True)
        right.plot(np.degrees(np.arctan2(u[:, 1], u[:, 0])), u[:, 2], '.', ms=2,
                   color='tab:blue', rasterized=True)
        right.set_xlim(-180.0, 180.0)
        right.set_ylim(-1.0, 1.0)
        right.set_xlabel('azimuth of the field [degrees]')
        right.set_ylabel('z component')
        right.set_title(f'directions (equal-area), coverage {fit.coverage:.2f}', fontsize=9)
        for axes in (left, right):
            axes.grid(alpha=0.3)
    return figure


def geometry_figure(survey: GeometrySurvey) -> Figure:
    """Plot the corrections of the sensor positions, orientations and gains, and the residuals."""
    g, names = survey.geometry, survey.network.names
    n = len(names)
    suspect = np.isin(names, g.suspect_sensors)
    figure = Figure(figsize=(15.0, 9.5), layout='constrained')
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.15))
    board, poses = left.subplots(2, 1, height_ratios=(2.4, 1.0))
    _plot_displacements(left, board, survey, suspect)
    _plot_pose_residuals(poses, survey)
    rows = right.subplots(4, 1, sharex=True)
    indices = np.arange(n)
    displacement = survey.network.positions - survey.nominal.positions
    _plot_corrections(rows[0], indices, 1e3 * np.linalg.norm(displacement, axis=1),
                      1e3 * g.position_std, 'displacement [mm]')
    _plot_corrections(rows[1], indices, np.rad2deg(survey.rotation_angle),
                      np.rad2deg(g.rotation_std), 'rotation [deg]')
    rows[2].errorbar(indices, g.gain, yerr=SCALE_1D * g.gain_std, fmt='o', ms=4, capsize=2,
                     color='tab:blue')
    rows[2].axhline(1.0, color='k', lw=0.8, ls=':')
    rows[2].set_title('gain (90 %)', fontsize=10, loc='left')
    _plot_residuals(rows[3], indices, g.sensor_residual, suspect,
                    'residual in standard deviations (RMS; 1 for correct noise and field error)')
    step = -(-n // MAX_NAMES)
    rows[3].set_xticks(indices[::step], [literal(name) for name in names[::step]], rotation=90,
                       fontsize=7)
    rows[3].set_xlim(-0.7, n - 0.3)
    return figure


def _plot_displacements(figure: SubFigure, axes: Axes, survey: GeometrySurvey,
                        suspect: BoolArray) -> None:
    """Plot the board, viewed along its thinnest axis, with magnified arrows for displacements."""
    positions = survey.nominal.positions
    a, b = _widest_axes(positions)
    c = 3 - a - b
    shift = 1e3 * (survey.network.positions - positions)
    extent = np.ptp(positions, axis=0).max() or 1.0
    longest = np.linalg.norm(shift[:, [a, b]], axis=1).max()
    key = _round_down(longest) or 1.0
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
            axes.annotate(literal(name), position[[a, b]], xytext=(3, -8),
                          textcoords='offset points', fontsize=6, color='0.35')
    # A few distant poses must not extend the axes.
    low, high = positions.min(axis=0) - 0.15 * extent, positions.max(axis=0) + 0.15 * extent
    axes.set_xlim(low[a], high[a])
    axes.set_ylim(low[b], high[b])
    axes.set_aspect('equal')
    axes.set_xlabel(f'{"xyz"[a]} [m]')
    axes.set_ylabel(f'{"xyz"[b]} [m]')
    axes.set_title('displacement from the nominal positions', fontsize=10, loc='left')
    axes.legend(fontsize=7, ncols=3, loc='upper center', bbox_to_anchor=(0.5, -0.12),
                frameon=False)
    figure.colorbar(arrows, ax=axes, shrink=0.7, label=f'displacement along {"xyz"[c]} [mm]')


def _widest_axes(positions: FloatArray) -> tuple[int, int]:
    """Indices of the two axes along which the board is widest, in ascending order."""
    a, b = sorted(np.argsort(np.ptp(positions, axis=0), kind='stable')[1:])
    return int(a), int(b)


def _round_down(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten; 0 unless `value` is positive."""
    if not value > 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1.0, 2.0, 5.0) if m * power <= value * (1.0 + 1e-9)))


def _plot_corrections(axes: Axes, indices: IntArray, magnitude: FloatArray, std: FloatArray,
                      title: str) -> None:
    """Plot the magnitude of the correction of each sensor, and its 90 % uncertainty per axis."""
    axes.bar(indices, SCALE_1D * np.sqrt(np.square(std).mean(axis=1)), color='0.85', width=0.8,
             label='uncertainty (90 %, per axis)')
    axes.plot(indices, magnitude, 'o', ms=4, color='tab:blue', label='correction')
    axes.set_title(title, fontsize=10, loc='left')
    axes.legend(fontsize=7, ncols=2, loc='lower right', bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes.grid(alpha=0.3)


def _plot_residuals(axes: Axes, indices: IntArray, residual: FloatArray, suspect: BoolArray,
                    title: str) -> None:
    """Plot the residuals of the sensors as bars; bars of suspect sensors are red."""
    axes.bar(indices, np.nan_to_num(residual), width=0.8,
             color=np.where(suspect, SUSPECT_COLOUR, 'tab:blue').tolist())
    axes.axhline(1.0, color='k', lw=0.8, ls=':')
    axes.set_title(title, fontsize=10, loc='left')
    axes.grid(alpha=0.3)


def _plot_pose_residuals(axes: Axes, survey: GeometrySurvey) -> None:
    """Plot the residual of each magnet pose against its row in the table of poses."""
    suspect = np.isin(survey.rows, survey.suspect_rows)
    residual = survey.geometry.pose_residual
    axes.plot(survey.rows[~suspect], residual[~suspect], '.', ms=4, color='tab:blue')
    axes.plot(survey.rows[suspect], residual[suspect], 'o', ms=5, color=SUSPECT_COLOUR)
    axes.set_ylim(0.0)
    axes.axhline(1.0, color='k', lw=0.8, ls=':')
    axes.set_title('residual of the poses, relative to the noise'
                   + (f'; suspect: {suspect.sum()} (red)' if suspect.any() else ''),
                   fontsize=10, loc='left')
    axes.grid(alpha=0.3)
    axes.set_xlabel('row of the table')
