"""Figures of the geometry of a board; each function returns one figure."""

from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.report.figures import SCALE_1D
from mag_tracking.report.literal_text import literal

_SUSPECT_COLOUR = 'tab:red'
_MAX_NAMES = 60
"""Maximum number of sensor names on an axis. In a larger network, only every second, third, ...
name is drawn."""


class _Network(Protocol):
    """Attributes of a `SensorNetwork` that the figures use."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def positions(self) -> FloatArray: ...


class _Geometry(Protocol):
    """Attributes of a `NetworkGeometry` that the figures use."""

    @property
    def position_std(self) -> FloatArray: ...

    @property
    def rotation_std(self) -> FloatArray: ...

    @property
    def gain(self) -> FloatArray: ...

    @property
    def gain_std(self) -> FloatArray: ...

    @property
    def sensor_residual(self) -> FloatArray: ...

    @property
    def pose_residual(self) -> FloatArray: ...

    @property
    def suspect_sensors(self) -> tuple[str, ...]: ...

    @property
    def poses(self) -> tuple[FloatArray, FloatArray]: ...


class _Survey(Protocol):
    """Attributes of a `GeometrySurvey` that the figures use."""

    @property
    def nominal(self) -> _Network: ...

    @property
    def network(self) -> _Network: ...

    @property
    def geometry(self) -> _Geometry: ...

    @property
    def rows(self) -> IntArray: ...

    @property
    def suspect_rows(self) -> tuple[int, ...]: ...

    @property
    def rotation_angle(self) -> FloatArray: ...


def geometry_figure(survey: _Survey) -> Figure:
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
    step = -(-n // _MAX_NAMES)
    rows[3].set_xticks(indices[::step], [literal(name) for name in names[::step]], rotation=90,
                       fontsize=7)
    rows[3].set_xlim(-0.7, n - 0.3)
    return figure


def _plot_displacements(figure: SubFigure, axes: Axes, survey: _Survey, suspect: BoolArray) -> None:
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
                  color=_SUSPECT_COLOUR, label='suspect sensor')
    if len(positions) <= _MAX_NAMES:
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
             color=np.where(suspect, _SUSPECT_COLOUR, 'tab:blue').tolist())
    axes.axhline(1.0, color='k', lw=0.8, ls=':')
    axes.set_title(title, fontsize=10, loc='left')
    axes.grid(alpha=0.3)


def _plot_pose_residuals(axes: Axes, survey: _Survey) -> None:
    """Plot the residual of each magnet pose against its row in the table of poses."""
    suspect = np.isin(survey.rows, survey.suspect_rows)
    residual = survey.geometry.pose_residual
    axes.plot(survey.rows[~suspect], residual[~suspect], '.', ms=4, color='tab:blue')
    axes.plot(survey.rows[suspect], residual[suspect], 'o', ms=5, color=_SUSPECT_COLOUR)
    axes.set_ylim(0.0)
    axes.axhline(1.0, color='k', lw=0.8, ls=':')
    axes.set_title('residual of the poses, relative to the noise'
                   + (f'; suspect: {suspect.sum()} (red)' if suspect.any() else ''),
                   fontsize=10, loc='left')
    axes.grid(alpha=0.3)
    axes.set_xlabel('row of the table')
