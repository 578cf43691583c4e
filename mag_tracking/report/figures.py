"""Figures of tracks, with 90 % regions, of passes to scale, and of values over time."""

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
from mag_tracking.report.road import road_of
from mag_tracking.units import NS

SCALE_2D = float(np.sqrt(chdtri(2, 0.1)))
"""Radius of a 90 % ellipse in the plane, in standard deviations."""
MIN_WEIGHT = 0.01
"""Minimum weight of a plotted hypothesis. Less probable hypotheses are omitted for clarity."""
N_VEHICLES = 5
ELLIPSE_M = 0.7
"""Minimum distance between the 90 % regions that are drawn [m]."""
WIDTH_IN, MAX_HEIGHT_IN, LEGEND_IN = 10.0, 6.0, 0.5
"""Width and maximum height of the map, and height of the legend below it [inches]."""
MARGIN_M, LABEL_M = 1.5, 1.7
"""Margin around vehicles and sensors, and distance of labels from vehicles [m]."""
OVERHANG_M, MIN_LENGTH_M = 1.3, 2.2
"""Length of a vehicle beyond its row of dipoles, and minimum length [m]; as in `body.js`."""
WIDTHS_M = ((1.0, 0.8), (5.0, 1.8), (np.inf, 2.5))
"""(maximum length of the row of dipoles, width of the vehicle) [m], as in `body.js`."""
GRASS, ASPHALT, LINE, DARK = '#eef1ea', '#d3d4d6', '#ffffff', '#333333'


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


def pass_figure(log: TrackLog, network: SensorNetwork, smoothed: ArrayLike | None = None,
                max_std: float = float('inf')) -> Figure:
    """Draw the pass of a vehicle as a picture with a scale bar.

    The vehicle is drawn to scale at five published poses. Earlier 90 % regions are fainter.
    Ambiguous poses are omitted, as are those with a std of the horizontal position above `max_std`
    [m]. `smoothed` are positions (n, 3) [m].
    """
    drawn = _drawn_poses(log, max_std)
    positions = np.array(log.position)[:, :2]
    path = positions[drawn] if smoothed is None else np.asarray(smoothed)[:, :2]
    shown = _evenly_spaced(positions[drawn], N_VEHICLES)
    points = np.vstack([network.positions[:, :2], *(_shapes(log, k)[0] for k in drawn[shown])])
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    figure, axes = _empty_map(low, high)
    road = road_of(network.positions[:, :2], [path])
    for area in road.areas:
        axes.fill(*area.T, color=ASPHALT, lw=0, zorder=1)
    for marking in road.markings:
        axes.plot(*marking.T, color=LINE, lw=2.5, dashes=(7.0, 7.0), zorder=2)
    _draw_regions(axes, log, drawn)
    axes.plot(*path.T, color=style.VERMILLION, lw=2.5, zorder=4, label='smoothed path',
              solid_capstyle='round')
    _draw_vehicles(axes, log, drawn[shown], network.positions[:, :2])
    axes.plot(*positions[drawn].T, 'o', color=DARK, ms=2.5, zorder=6, label='published poses')
    axes.plot(*network.positions[:, :2].T, '^', ms=13, mfc=DARK, mec=LINE, mew=1.5, zorder=7,
              ls='none', label='magnetometers')
    for name, position in zip(network.names, network.positions, strict=True):
        axes.annotate(style.literal(name), position[:2], xytext=(12, 0), textcoords='offset points',
                      va='center', fontsize=12, color=DARK, zorder=8)
    _draw_scale(axes, low, high)
    figure.legend(loc='lower center', ncol=4, fontsize=11, frameon=False)
    return figure


def _drawn_poses(log: TrackLog, max_std: float) -> IntArray:
    """Indices of the unambiguous and precise poses; of all poses if there are fewer than two."""
    C = np.array(log.covariance)
    is_drawn = (C[:, 0, 0] + C[:, 1, 1] <= max_std**2) & ~np.array(log.ambiguous, dtype=bool)
    drawn = np.flatnonzero(is_drawn)
    return drawn if len(drawn) > 1 else np.arange(len(log.stamp_ns))


def _empty_map(low: FloatArray, high: FloatArray) -> tuple[Figure, Axes]:
    """New figure and axes with the extent from `low` to `high` [m], without ticks."""
    width, height = WIDTH_IN, WIDTH_IN * float((high[1] - low[1]) / (high[0] - low[0]))
    if height > MAX_HEIGHT_IN:
        # The map is extended to the sides.
        excess = (WIDTH_IN / MAX_HEIGHT_IN * (high[1] - low[1]) - (high[0] - low[0])) / 2.0
        low[0], high[0], height = low[0] - excess, high[0] + excess, MAX_HEIGHT_IN
    figure = Figure(figsize=(width, height + LEGEND_IN))
    bottom = LEGEND_IN / (height + LEGEND_IN)
    axes = figure.add_axes((0.0, bottom, 1.0, 1.0 - bottom), facecolor=GRASS, xticks=[],
                           yticks=[])
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), autoscale_on=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return figure, axes


def _draw_regions(axes: Axes, log: TrackLog, drawn: IntArray) -> None:
    """Draw the 90 % regions of poses at least `ELLIPSE_M` apart; earlier regions are fainter."""
    before = None
    axes.fill([], [], color=style.BLUE, alpha=0.3, lw=0,
              label='90 % regions of the published poses')
    for rank, k in enumerate(drawn):
        position = log.position[k][:2]
        if before is not None and np.hypot(*(position - before)) < ELLIPSE_M:
            continue
        before = position
        age = 1.0 - rank / len(drawn)
        axes.fill(*ellipse_points(position, log.covariance[k][:2, :2]).T, fc=style.BLUE,
                  ec=style.BLUE, lw=0.8, alpha=0.30 - 0.22 * age, zorder=3)


def _evenly_spaced(points: FloatArray, n: int) -> IntArray:
    """Indices of up to `n` points (k, 2) at even distances along their path."""
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    wanted = np.linspace(0.0, distance[-1], n)
    indices: IntArray = np.unique(np.abs(distance - wanted[:, None]).argmin(axis=1))
    return indices


def _shapes(log: TrackLog, k: int) -> list[FloatArray]:
    """Polygons (n, 2) of the body and the windows of the vehicle at pose `k`."""
    length = max(log.length[k] + OVERHANG_M, MIN_LENGTH_M)
    width = next(width for limit, width in WIDTHS_M if log.length[k] < limit)
    u = np.array([length, width]) / 2.0
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    # A superellipse is a rectangle with rounded corners.
    corner = np.stack([np.cos(angle), np.sin(angle)])
    body = (np.sign(corner) * np.abs(corner)**0.35).T * u
    windows = [np.array([[a, -0.78], [b, -0.66], [b, 0.66], [a, 0.78]]) * u
               for a, b in ((0.42, 0.16), (-0.74, -0.56))]
    c, s = log.velocity[k][:2] / np.hypot(*log.velocity[k][:2])
    return [log.position[k][:2] + shape @ np.array([[c, s], [-s, c]])
            for shape in (body, *windows)]


def _draw_vehicles(axes: Axes, log: TrackLog, shown: IntArray, sensors: FloatArray) -> None:
    for rank, k in enumerate(shown):
        alpha = 0.35 + 0.65 * rank / max(1, len(shown) - 1)
        body, *windows = _shapes(log, k)
        axes.fill(*body.T, fc=style.BLUE, ec=LINE, lw=1.2, alpha=alpha, zorder=5)
        for window in windows:
            axes.fill(*window.T, fc='#dcecf7', lw=0, alpha=alpha, zorder=5)
        # The label is beside the vehicle, at the side with the greater distance from the sensors.
        direction = log.velocity[k][:2] / np.hypot(*log.velocity[k][:2])
        sides = log.position[k][:2] + LABEL_M * np.outer([1.0, -1.0], direction[::-1] * [1.0, -1.0])
        place = max(sides, key=lambda side: np.hypot(*(sensors - side).T).min())
        axes.annotate(f'{(log.stamp_ns[k] - log.stamp_ns[shown[0]]) / NS:.1f} s', place,
                      ha='center', va='center', fontsize=11, color=DARK, zorder=8)


def _draw_scale(axes: Axes, low: FloatArray, high: FloatArray) -> None:
    """Draw a scale bar of up to a sixth of the width of the map."""
    length = max(v for v in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
                 if v <= max((high[0] - low[0]) / 6.0, 1.0))
    axes.plot([high[0] - 0.5 - length, high[0] - 0.5], [low[1] + 0.5] * 2, color=DARK, lw=4,
              solid_capstyle='butt', zorder=8)
    axes.annotate(f'{length:g} m', (high[0] - 0.5 - length / 2.0, low[1] + 0.5), xytext=(0, 6),
                  textcoords='offset points', ha='center', fontsize=11, color=DARK, zorder=8)
