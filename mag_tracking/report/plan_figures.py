"""Figures of a sensor placement plan; each function returns one figure."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from mag_tracking.arrays import FloatArray
from mag_tracking.report.literal_text import literal
from mag_tracking.report.palette import SERIES_COLOURS
from mag_tracking.report.scales import scale_of
from mag_tracking.report.style import legend_beside, plain_log_ticks

MIN_MISSED = 1e-6
"""Probabilities of a missed pass below this value are not drawn."""


class _Network(Protocol):
    """Attributes of a `SensorNetwork` that the figures use."""

    @property
    def positions(self) -> FloatArray: ...


class _Lane(Protocol):
    """Attributes of a `Lane` that the figures use."""

    @property
    def name(self) -> str: ...

    @property
    def along(self) -> FloatArray: ...

    @property
    def points(self) -> FloatArray: ...

    @property
    def pass_std(self) -> FloatArray: ...

    @property
    def filter_std(self) -> FloatArray: ...

    @property
    def detection(self) -> FloatArray: ...


class _Plan(Protocol):
    """Attributes of a `Plan` that the figures use."""

    @property
    def network(self) -> _Network: ...

    @property
    def x(self) -> FloatArray: ...

    @property
    def y(self) -> FloatArray: ...

    @property
    def position_std(self) -> FloatArray: ...

    @property
    def detection(self) -> FloatArray: ...

    @property
    def std_with_added_sensor(self) -> FloatArray: ...

    @property
    def miss_curve(self) -> FloatArray: ...

    @property
    def lanes(self) -> Sequence[_Lane]: ...

    @property
    def std_without_added_sensor(self) -> float: ...

    @property
    def best_position(self) -> tuple[float, float]: ...


def _draw_map(plan: _Plan, title: str) -> tuple[Figure, Axes, float, str]:
    """Draw a map with the sensors and the lanes; return figure, axes, length factor and unit."""
    f, unit = scale_of(np.ptp(plan.x))
    figure = Figure(figsize=(8.0, 6.8), layout='constrained')
    axes = figure.add_subplot()
    axes.set_aspect('equal')
    axes.set_xlabel(f'x [{unit}]')
    axes.set_ylabel(f'y [{unit}]')
    axes.set_title(title, fontsize=11)
    for lane in plan.lanes:
        low, high = (plan.x[0], plan.y[0]), (plan.x[-1], plan.y[-1])
        inside = f * lane.points[((lane.points >= low) & (lane.points <= high)).all(axis=1)]
        axes.plot(*inside.T, '--', color='0.25', lw=0.8)
        if len(inside) > 3:
            axes.annotate('', inside[-1], inside[-4],
                          arrowprops={'arrowstyle': '-|>', 'color': '0.25'})
    axes.plot(*(f * plan.network.positions[:, :2]).T, 'k^', ms=8, mec='w', zorder=5)
    axes.set_xlim(f * plan.x[0], f * plan.x[-1])
    axes.set_ylim(f * plan.y[0], f * plan.y[-1])
    return figure, axes, f, unit


def _levels(values: FloatArray, factor: float) -> FloatArray:
    """Contour levels within the range of `factor` times `values`: 1, 2 or 5 times powers of ten, or
    the geometric mean of the range if it contains none of these."""
    powers_of_ten = 10.0 ** np.arange(-6, 7)
    levels = np.sort(np.concatenate([powers_of_ten, 2.0 * powers_of_ten, 5.0 * powers_of_ten]))
    low, high = factor * np.nanmin(values), factor * np.nanmax(values)
    inside = levels[(levels > low) & (levels < high)]
    return inside if len(inside) else np.array([np.sqrt(low * high)])


def position_figure(plan: _Plan) -> Figure:
    """Map of the Cramér-Rao bound on the position (std), for a whole pass through each point."""
    figure, axes, f, unit = _draw_map(
        plan, 'Position bound from a whole pass through each point (standard deviation)')
    z = f * np.clip(plan.position_std, None, np.ptp(plan.x))
    mesh = axes.pcolormesh(f * plan.x, f * plan.y, z, norm=LogNorm(), cmap='viridis',
                           shading='nearest', rasterized=True)
    lines = axes.contour(f * plan.x, f * plan.y, z, levels=_levels(z, 1.0), colors='w',
                         linewidths=0.8)
    axes.clabel(lines, fmt=f'%g {unit}', fontsize=8)
    figure.colorbar(mesh, ax=axes, label=f'horizontal standard deviation [{unit}]')
    return figure


def detection_figure(plan: _Plan) -> Figure:
    """Map of the probability that one frame detects the target."""
    figure, axes, f, _ = _draw_map(plan, 'Probability that one frame detects the target')
    mesh = axes.pcolormesh(f * plan.x, f * plan.y, plan.detection, vmin=0.0, vmax=1.0,
                           cmap='magma', shading='nearest', rasterized=True)
    levels = [p for p in (0.1, 0.5, 0.9, 0.99) if plan.detection.min() < p < plan.detection.max()]
    if levels:
        lines = axes.contour(f * plan.x, f * plan.y, plan.detection, levels=levels, colors='c',
                             linewidths=0.9)
        axes.clabel(lines, fmt=lambda p: f'{100 * p:g} %', fontsize=8)
    figure.colorbar(mesh, ax=axes, label='probability of detection')
    return figure


def sensor_figure(plan: _Plan) -> Figure:
    """Map of the reduction [%] of the median position bound by an additional sensor at each point.

    The map is white where no sensor is allowed.
    """
    gain = 1.0 - plan.std_with_added_sensor / plan.std_without_added_sensor
    possible = np.isfinite(gain).any()
    figure, axes, f, unit = _draw_map(
        plan, 'Improvement by one additional sensor\n(median bound near the sensors without it: '
        f'{length_text(plan.std_without_added_sensor)})')
    ny, nx = gain.shape
    x, y = np.linspace(plan.x[0], plan.x[-1], nx), np.linspace(plan.y[0], plan.y[-1], ny)
    mesh = axes.pcolormesh(f * x, f * y, 100.0 * gain, cmap='cividis', shading='nearest',
                           rasterized=True)
    if not possible:
        return figure
    best = plan.best_position
    axes.plot(f * best[0], f * best[1], 'r*', ms=15, mec='w', clip_on=False, zorder=6,
              label=f'best: ({f * best[0]:.3g}, {f * best[1]:.3g}) {unit}, bound '
              f'{length_text(np.nanmin(plan.std_with_added_sensor))}')
    axes.legend(fontsize=9, loc='upper right')
    figure.colorbar(mesh, ax=axes, label='reduction of the bound [%]')
    return figure


def length_text(metres: float) -> str:
    """Length in a readable unit."""
    return f'{metres:.3g} m' if metres >= 0.01 else f'{1e3 * metres:.2g} mm'


def distinct_lanes(lanes: Sequence[_Lane]) -> list[tuple[str, _Lane]]:
    """Group lanes with identical curves, which would overlap in a plot.

    Return the combined names of each group, and its first lane.
    """
    out: list[tuple[list[str], _Lane]] = []
    for lane in lanes:
        for names, other in out:
            if all(np.array_equal(a.shape, b.shape) and np.allclose(a, b, rtol=1e-3) for a, b in (
                    (lane.along, other.along), (lane.filter_std, other.filter_std),
                    (lane.pass_std, other.pass_std), (lane.detection, other.detection))):
                names.append(literal(lane.name))
                break
        else:
            out.append(([literal(lane.name)], lane))
    return [(' and '.join(names), lane) for names, lane in out]


def lane_figure(plan: _Plan) -> Figure:
    """Plot bounds and detection probability along the lanes, and P(missed pass) by distance."""
    figure = Figure(figsize=(10.0, 9.0), layout='constrained')
    top, middle, bottom = figure.subplots(3, 1)
    f, unit = scale_of(np.ptp(plan.x))
    for k, (name, lane) in enumerate(distinct_lanes(plan.lanes)):
        colour = SERIES_COLOURS[k % len(SERIES_COLOURS)]
        top.semilogy(f * lane.along, f * lane.filter_std, '-', color=colour,
                     label=f'{name}: filter')
        top.semilogy(f * lane.along, f * lane.pass_std[:, 0], '--', color=colour,
                     label=f'{name}: whole pass')
        middle.plot(f * lane.along, lane.detection, color=colour, label=name)
    top.set_ylabel(f'position bound [{unit}]')
    top.set_ylim(top=min(top.get_ylim()[1], f * np.ptp(plan.x)))
    legend_beside(top)
    plain_log_ticks(top)
    top.set_title('Along the lanes, in the direction of travel (0 is nearest to the centre)')
    middle.set_ylabel('P(detection by one frame)')
    middle.set_xlabel(f'distance along the lane [{unit}]')
    legend_beside(middle)
    drawn_rows = plan.miss_curve[plan.miss_curve[:, 1] >= MIN_MISSED]
    bottom.semilogy(f * drawn_rows[:, 0], drawn_rows[:, 1], '.-', color='k')
    bottom.set_xlim(f * plan.miss_curve[0, 0], 1.02 * f * plan.miss_curve[-1, 0])
    bottom.set_ylim(0.5 * MIN_MISSED, 2.0)
    bottom.set_xlabel(f'lateral distance of a pass from the centre of the sensors [{unit}]')
    bottom.set_ylabel('P(missed pass)')
    for axes in (top, middle, bottom):
        axes.grid(alpha=0.3)
    return figure
