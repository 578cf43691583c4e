"""Figures of a run: one function a figure, each returns the figure.

Uncertainty is drawn as 90 % regions throughout.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.report.literal_text import literal
from mag_tracking.report.track_log import TrackLog

SCALE_2D = float(np.sqrt(chdtri(2, 0.1)))
"""Deviations to the edge of a 90 % ellipse in the plane."""
SCALE_1D = 1.645
"""Deviations to the edge of a 90 % interval."""

_COLOURS = ('tab:blue', 'tab:orange', 'tab:green', 'tab:purple', 'tab:brown', 'tab:cyan')


class _Network(Protocol):
    """What the figures read of a `SensorNetwork`."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def positions(self) -> FloatArray: ...

    def __len__(self) -> int: ...


def _ellipse(position: FloatArray, covariance: FloatArray, n: int = 48) -> FloatArray:
    """Points (n, 2) on the edge of the 90 % region of a position in the plane."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, n)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    edge: FloatArray = (vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)).T
    return position[:2] + edge * SCALE_2D


def _colours(log: TrackLog) -> dict[str, str]:
    """{arrival: colour}, in a fixed order."""
    names = sorted({name for row in log.arrivals for name in row})
    return {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(names)}


def scale_of(extent: float) -> tuple[float, str]:
    """(factor, unit) that makes a length of `extent` metres readable."""
    return (1.0, 'm') if extent > 1.0 else (1e3, 'mm')


def field_unit(strongest: float) -> tuple[float, str]:
    """(factor, unit) that makes fields up to `strongest` [T] readable."""
    return (1e9, 'nT') if strongest < 1e-5 else (1e6, 'µT') if strongest < 1e-2 else (1e3, 'mT')


def _without_switches(rows: Sequence[tuple[int, float, FloatArray, FloatArray]]) -> FloatArray:
    """Points (n, 2), with NaN where the best of an arrival is suddenly elsewhere: another one."""
    points = np.array([r[2][:2] for r in rows])
    certain = np.array([3.0 * np.sqrt(np.trace(r[3])) for r in rows])
    steps = np.hypot(*np.diff(points, axis=0).T)
    usual = 4.0 * np.median(steps) if len(steps) else 0.0
    switch = np.flatnonzero(steps > np.maximum(usual, 0.5 * certain[1:])) + 1
    return np.insert(points, switch, np.nan, axis=0)


def map_figure(log: TrackLog, network: _Network, truth: FloatArray | None = None,
               smoothed: ArrayLike | None = None) -> Figure:
    """The map: trajectories of the hypotheses with 90 % ellipses, sensors and truth.

    Parameters
    ----------
    log : TrackLog
    network : SensorNetwork
    truth : (n, 3) [m], optional
    smoothed : (n, 3) [m], optional
    """
    figure = Figure(figsize=(7.5, 6.5), layout='constrained')
    axes = figure.add_subplot()
    best = np.array(log.position)
    reach = np.vstack([best[:, :2], network.positions[:, :2]])
    low, high = reach.min(axis=0), reach.max(axis=0)
    f, unit = scale_of((high - low).max())
    span = max((high - low).max(), 1e-6)
    every = max(1, len(best) // 14)
    colours = _colours(log)
    for name, colour in colours.items():
        rows = [(k, *row[name]) for k, row in enumerate(log.arrivals) if name in row]
        points = f * _without_switches(rows)
        weight = rows[-1][1] if rows[-1][0] == len(best) - 1 else 0.0
        axes.plot(*points.T, color=colour, lw=1.8 if weight > 0.5 else 1.0,
                  label=f'{literal(name) or "hypothesis"} ({weight:.0%} at the end)')
        for k, _, position, covariance in rows:
            if k % every == 0:
                axes.fill(*(f * _ellipse(position, covariance)).T, color=colour,
                          alpha=0.10 if weight > 0.5 else 0.04, lw=0)
    if truth is not None and np.isfinite(truth).any():
        axes.plot(f * truth[:, 0], f * truth[:, 1], 'k--', lw=1.2, label='truth')
    if smoothed is not None:
        axes.plot(*(f * np.asarray(smoothed)[:, :2]).T, color='tab:red', lw=1.4,
                  label='smoothed')
    axes.plot(f * network.positions[:, 0], f * network.positions[:, 1], 'k^', ms=8,
              label='magnetometers')
    axes.plot(*(f * best[0, :2]), 'o', mfc='w', mec='k', ms=6, label='first pose')
    middle, half = 0.5 * (low + high), 0.5 * span + 0.12 * span
    axes.set_xlim(f * (middle[0] - half), f * (middle[0] + half))
    axes.set_ylim(f * (middle[1] - half), f * (middle[1] + half))
    axes.set_aspect('equal')
    axes.set_xlabel(f'x [{unit}]')
    axes.set_ylabel(f'y [{unit}]')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc='best')
    axes.set_title(f'Track {log.id}: hypotheses with 90 % ellipses')
    return figure


def weights_figure(log: TrackLog) -> Figure:
    """The weight of each arrival over time, linear and logarithmic.

    Parameters
    ----------
    log : TrackLog
    """
    figure = Figure(figsize=(7.5, 4.5), layout='constrained')
    top, bottom = figure.subplots(2, 1, sharex=True)
    t = log.seconds()
    for name, colour in _colours(log).items():
        w = np.array([row[name][0] if name in row else 0.0 for row in log.arrivals])
        top.plot(t, w, color=colour, label=literal(name) or 'hypothesis')
        bottom.semilogy(t, np.where(w > 0.0, w, np.nan), color=colour)
    top.set_ylim(-0.03, 1.03)
    top.set_ylabel('weight')
    top.legend(fontsize=8)
    top.set_title(f'Track {log.id}: weight of each arrival direction (gone = dropped)')
    bottom.set_ylim(1e-13, 3.0)
    bottom.set_ylabel('weight (log)')
    bottom.set_xlabel('time since the first pose [s]')
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    return figure


def field_figure(log: TrackLog, network: _Network, most: int = 8) -> Figure:
    """Measured field against that of the best hypothesis, per sensor and axis.

    Parameters
    ----------
    log : TrackLog
    network : SensorNetwork
    most : int
        Sensors drawn; with more, those with the strongest field (the title says so).
    """
    measured, predicted = np.array(log.measured), np.array(log.predicted)
    strength = np.nan_to_num(np.nanmax(np.abs(np.where(np.isnan(measured), 0.0, measured)),
                                       axis=(0, 2)))
    rows = np.sort(np.argsort(-strength, kind='stable')[:most])
    columns = 2 if len(rows) > 1 else 1
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(9.5, 1.2 + 2.4 * lines), layout='constrained')
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True)
    f, unit = field_unit(strength.max())
    t = log.seconds()
    for axes in grid.flat[len(rows):]:
        axes.set_visible(False)
    for axes, j in zip(grid.flat, rows, strict=False):
        for a, colour in enumerate(('tab:red', 'tab:green', 'tab:blue')):
            axes.plot(t, f * measured[:, j, a], '.', ms=4, color=colour,
                      label=f'{"xyz"[a]} measured' if j == rows[0] else None)
            axes.plot(t, f * predicted[:, j, a], '-', lw=1.2, color=colour,
                      label=f'{"xyz"[a]} predicted' if j == rows[0] else None)
        axes.set_title(literal(network.names[j]), fontsize=9)
        axes.set_ylabel(f'field [{unit}]')
        axes.grid(alpha=0.3)
    for axes in grid[-1]:
        axes.set_xlabel('time since the first pose [s]')
    grid[0, 0].legend(fontsize=7, ncol=2)
    shown = '' if len(rows) == len(network) else f' (the strongest {len(rows)} of {len(network)})'
    figure.suptitle(f'Track {log.id}: measured and predicted field, sensor frame{shown}')
    return figure
