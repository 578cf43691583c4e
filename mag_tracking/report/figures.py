"""Figures of tracks, with 90 % regions, and of values over time; each function returns one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.special import chdtri

from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.report import style
from mag_tracking.report.page_scene import strongest_sensors

SCALE_2D = float(np.sqrt(chdtri(2, 0.1)))
"""Radius of a 90 % ellipse in the plane, in standard deviations."""
MIN_WEIGHT = 0.01
"""Minimum weight of a plotted hypothesis. Less probable hypotheses are omitted for clarity."""


def ellipse_points(position: FloatArray, covariance: FloatArray, n: int = 48) -> FloatArray:
    """Points (n, 2) on the edge of the 90 % region of a position in the plane."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, n)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    edge: FloatArray = (vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)).T
    return position[:2] + edge * SCALE_2D


def _colours(log: TrackLog) -> dict[str, str]:
    names = sorted({name for row in log.arrivals for name in row})
    return {name: style.series_colour(i) for i, name in enumerate(names)}


def _without_switches(points: FloatArray, covariances: FloatArray) -> FloatArray:
    """Insert NaN into points (n, 2) at jumps, where the best hypothesis has probably changed."""
    uncertainty = 3.0 * np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    steps = np.hypot(*np.diff(points, axis=0).T)
    typical_step = 4.0 * np.median(steps) if len(steps) else 0.0
    switches = np.flatnonzero(steps > np.maximum(typical_step, 0.5 * uncertainty[1:])) + 1
    return np.insert(points, switches, np.nan, axis=0)


def map_figure(log: TrackLog, network: SensorNetwork, truth: FloatArray | None = None,
               smoothed: ArrayLike | None = None) -> Figure:
    """Plot a track with 90 % ellipses, hypotheses, sensors, and paths (n, 3) [m]."""
    figure = Figure(figsize=(8.5, 6.5), layout='constrained')
    axes = figure.add_subplot()
    positions = np.array(log.position)[:, :2]
    covariance = np.array(log.covariance)[:, :2, :2]
    ambiguous = np.array(log.ambiguous, dtype=bool)
    map_points = np.vstack([positions, network.positions[:, :2]])
    low, high = map_points.min(axis=0), map_points.max(axis=0)
    span = max((high - low).max(), 1e-6)
    f, unit = style.scale_of(span)
    _draw_arrivals(axes, log, f)
    for k in range(0, len(positions), max(1, len(positions) // 14)):
        axes.fill(*(f * ellipse_points(positions[k], covariance[k])).T, color='k', lw=0,
                  alpha=0.04 if ambiguous[k] else 0.10)
    axes.plot(*(f * _without_switches(positions, covariance)).T, color='k', lw=1.8, label='track')
    if ambiguous.any():
        axes.plot(*(f * positions[ambiguous]).T, 'o', mfc='w', mec='k', ms=4,
                  label='ambiguous pose')
    axes.plot(*(f * positions[0]), 's', mfc='w', mec='k', ms=7, label='first pose')
    if truth is not None and np.isfinite(truth).any():
        axes.plot(f * truth[:, 0], f * truth[:, 1], '--', color='0.5', lw=1.4, label='truth')
    if smoothed is not None:
        axes.plot(*(f * np.asarray(smoothed)[:, :2]).T, color=style.VERMILLION, lw=1.4,
                  label='smoothed')
    axes.plot(f * network.positions[:, 0], f * network.positions[:, 1], 'k^', ms=8,
              label='magnetometers')
    middle, half = 0.5 * (low + high), 0.5 * span + 0.12 * span
    axes.set(xlim=(f * (middle[0] - half), f * (middle[0] + half)),
             ylim=(f * (middle[1] - half), f * (middle[1] + half)), aspect='equal',
             xlabel=f'x [{unit}]', ylabel=f'y [{unit}]',
             title=f'Track {log.id} with 90 % ellipses')
    axes.grid(alpha=0.3)
    style.legend_beside(axes)
    return figure


def _draw_arrivals(axes: Axes, log: TrackLog, f: float) -> None:
    """Plot the best hypothesis of each of several arrival directions above `MIN_WEIGHT`."""
    colours = _colours(log)
    if len(colours) < 2:
        return
    for name, colour in colours.items():
        rows = [row[name] for row in log.arrivals if name in row and row[name][0] > MIN_WEIGHT]
        if not rows:
            continue
        points = _without_switches(np.array([position[:2] for _, position, _ in rows]),
                                   np.array([C for *_, C in rows]))
        weight = log.arrivals[-1].get(name, (0.0,))[0]
        axes.plot(*(f * points).T, color=colour, lw=3.0 if weight > 0.5 else 1.2, alpha=0.8,
                  label=f'from {style.literal(name)} ({weight:.0%} at the end)')


def weights_figure(log: TrackLog) -> Figure:
    """Plot the weight of each arrival direction over time, on a linear and a logarithmic axis."""
    figure = Figure(figsize=(8.5, 4.5), layout='constrained')
    top, bottom = figure.subplots(2, 1, sharex=True)
    t = log.seconds()
    for name, colour in _colours(log).items():
        w = np.array([row[name][0] if name in row else 0.0 for row in log.arrivals])
        top.plot(t, w, color=colour, label=style.literal(name) or 'all hypotheses')
        bottom.semilogy(t, np.where(w > 0.0, w, np.nan), color=colour)
    style.legend_beside(top)
    subject = 'each arrival direction (a line ends when its direction is pruned)' \
        if any(_colours(log)) else 'the hypotheses, which have no arrival directions'
    top.set(ylim=(-0.03, 1.03), ylabel='weight', title=f'Track {log.id}: weight of {subject}')
    bottom.set(ylim=(1e-13, 3.0), ylabel='weight (log)', xlabel='time since the first pose [s]')
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    return figure


def field_figure(log: TrackLog, network: SensorNetwork) -> Figure:
    """Plot the measured and the predicted field of the `strongest_sensors` per axis."""
    measured, predicted = np.array(log.measured), np.array(log.predicted)
    sensors = strongest_sensors(log)
    n_columns = 2 if len(sensors) > 1 else 1
    n_rows = -(-len(sensors) // n_columns)
    figure = Figure(figsize=(9.5, 1.2 + 2.4 * n_rows), layout='constrained')
    grid = figure.subplots(n_rows, n_columns, squeeze=False, sharex=True)
    f, unit = style.field_unit(np.nan_to_num(np.abs(measured)).max())
    t = log.seconds()
    for axes in grid.flat[len(sensors):]:
        axes.set_visible(False)
    for axes, j in zip(grid.flat, sensors, strict=False):
        for a, colour in enumerate(style.AXIS_COLOURS):
            axes.plot(t, f * measured[:, j, a], '.', ms=4, color=colour,
                      label=f'{"xyz"[a]} measured' if j == sensors[0] else None)
            axes.plot(t, f * predicted[:, j, a], '-', lw=1.2, color=colour,
                      label=f'{"xyz"[a]} predicted' if j == sensors[0] else None)
        axes.set_title(style.literal(network.names[j]), fontsize=9)
        axes.set_ylabel(f'field [{unit}]')
        axes.grid(alpha=0.3)
    for axes in grid[-1]:
        axes.set_xlabel('time since the first pose [s]')
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, ncol=6, loc='outside lower center')
    selection = '' if len(sensors) == len(network) \
        else f' (the strongest {len(sensors)} of {len(network)})'
    figure.suptitle(f'Track {log.id}: measured and predicted field, sensor frame{selection}')
    return figure


def time_figure(stamp_ns: IntArray, values: FloatArray, std: FloatArray | None,
                groups: Sequence[str], label: str) -> Figure:
    """Draw values (n,), with standard deviations if known, over time, a colour per group."""
    figure = Figure(figsize=(8.0, 3.5), layout='constrained')
    axis = figure.add_subplot()
    times = np.asarray(stamp_ns, dtype='datetime64[ns]')
    for k, group in enumerate(dict.fromkeys(groups)):
        rows = np.array([g == group for g in groups])
        axis.errorbar(times[rows], values[rows], None if std is None else std[rows], fmt='o',
                      color=style.series_colour(k), label=style.literal(group))
    axis.set(xlabel='time (UTC)', ylabel=label)
    axis.grid(True, alpha=0.3)
    if len(groups):
        style.legend_beside(axis)
    else:
        axis.text(0.5, 0.5, 'nothing was found', transform=axis.transAxes, ha='center')
    return figure
