"""Picture of a pass: road, sensors, vehicle to scale, published track and smoothed path."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.report.figures import ellipse_points
from mag_tracking.report.road import road_of
from mag_tracking.report.style import BLUE, VERMILLION, literal
from mag_tracking.units import NS

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
    axes.plot(*path.T, color=VERMILLION, lw=2.5, zorder=4, label='smoothed path',
              solid_capstyle='round')
    _draw_vehicles(axes, log, drawn[shown], network.positions[:, :2])
    axes.plot(*positions[drawn].T, 'o', color=DARK, ms=2.5, zorder=6, label='published poses')
    axes.plot(*network.positions[:, :2].T, '^', ms=13, mfc=DARK, mec=LINE, mew=1.5, zorder=7,
              ls='none', label='magnetometers')
    for name, position in zip(network.names, network.positions, strict=True):
        axes.annotate(literal(name), position[:2], xytext=(12, 0), textcoords='offset points',
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
    axes.fill([], [], color=BLUE, alpha=0.3, lw=0, label='90 % regions of the published poses')
    for rank, k in enumerate(drawn):
        position = log.position[k][:2]
        if before is not None and np.hypot(*(position - before)) < ELLIPSE_M:
            continue
        before = position
        age = 1.0 - rank / len(drawn)
        axes.fill(*ellipse_points(position, log.covariance[k][:2, :2]).T, fc=BLUE, ec=BLUE, lw=0.8,
                  alpha=0.30 - 0.22 * age, zorder=3)


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
        axes.fill(*body.T, fc=BLUE, ec=LINE, lw=1.2, alpha=alpha, zorder=5)
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
