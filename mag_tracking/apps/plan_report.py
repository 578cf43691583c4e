"""Figures and report of a plan: maps of accuracy and detection, and curves along the lanes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from mag_tracking.apps.plan import GOOD_PD, Lane, Plan
from mag_tracking.arrays import FloatArray
from mag_tracking.quantities import quantity
from mag_tracking.report import page, style
from mag_tracking.results.result_folder import REPORT

MIN_MISSED = 1e-6
"""Probabilities of a missed pass below this value are not drawn."""
ROUND_NUMBERS = [10.0**k * m for k in range(-7, 8) for m in (1, 2, 5)]
LOW_QUANTILE = 0.02
"""Quantile of a bound at the lower end of its colour scale; the upper end is symmetric."""


def position_figure(plan: Plan) -> Figure:
    """Map of the Cramér-Rao bound on the position (std), for a whole pass through each point."""
    figure, axes, f, unit = _draw_map(
        plan, 'Position bound from a whole pass through each point (standard deviation)')
    z = f * np.clip(plan.position_std, None, np.ptp(plan.x))
    mesh = axes.pcolormesh(f * plan.x, f * plan.y, z, norm=LogNorm(), cmap='viridis',
                           shading='nearest', rasterized=True)
    low, high = np.nanmin(z), np.nanmax(z)
    levels = [v for v in ROUND_NUMBERS if low < v < high] or [np.sqrt(low * high)]
    lines = axes.contour(f * plan.x, f * plan.y, z, levels=levels, colors='w', linewidths=0.8)
    axes.clabel(lines, fmt=f'%g {unit}', fontsize=8)
    figure.colorbar(mesh, ax=axes, label=f'horizontal standard deviation [{unit}]')
    return figure


def detection_figure(plan: Plan) -> Figure:
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


def sensor_figure(plan: Plan) -> Figure:
    """Map of the reduction [%] of the bound by an additional sensor; white if not allowed."""
    figure, axes, f, unit = _draw_map(
        plan, 'Improvement by one additional sensor\n(median bound near the sensors without it: '
        f'{length_text(plan.std_without_added_sensor)})')
    x, y, gain = _gain(plan, f)
    mesh = axes.pcolormesh(x, y, gain, cmap='cividis', shading='nearest', rasterized=True)
    if not np.isfinite(gain).any():
        return figure
    best = plan.best_position
    axes.plot(f * best[0], f * best[1], 'r*', ms=15, mec='w', clip_on=False, zorder=6,
              label=f'best: ({f * best[0]:.3g}, {f * best[1]:.3g}) {unit}, bound '
              f'{length_text(np.nanmin(plan.std_with_added_sensor))}')
    axes.legend(fontsize=9, loc='upper right')
    figure.colorbar(mesh, ax=axes, label='reduction of the bound [%]')
    return figure


def lane_figure(plan: Plan) -> Figure:
    """Plot bounds and detection probability along the lanes, and P(missed pass) by distance."""
    figure = Figure(figsize=(10.0, 9.0), layout='constrained')
    top, middle, bottom = figure.subplots(3, 1)
    f, unit = style.scale_of(np.ptp(plan.x))
    for k, (name, lane) in enumerate(_distinct_lanes(plan.lanes)):
        colour = style.series_colour(k)
        top.semilogy(f * lane.along, f * lane.filter_std, '-', color=colour,
                     label=f'{name}: filter')
        top.semilogy(f * lane.along, f * lane.pass_std[:, 0], '--', color=colour,
                     label=f'{name}: whole pass')
        middle.plot(f * lane.along, lane.detection, color=colour, label=name)
    top.set(ylabel=f'position bound [{unit}]',
            ylim=(None, min(top.get_ylim()[1], f * np.ptp(plan.x))))
    style.legend_beside(top)
    style.plain_log_ticks(top)
    top.set_title('Along the lanes, in the direction of travel (0 is nearest to the centre)')
    middle.set(ylabel='P(detection by one frame)', xlabel=f'distance along the lane [{unit}]')
    style.legend_beside(middle)
    drawn_rows = plan.miss_curve[plan.miss_curve[:, 1] >= MIN_MISSED]
    bottom.semilogy(f * drawn_rows[:, 0], drawn_rows[:, 1], '.-', color='k')
    bottom.set(xlim=(f * plan.miss_curve[0, 0], 1.02 * f * plan.miss_curve[-1, 0]),
               ylim=(0.5 * MIN_MISSED, 2.0), ylabel='P(missed pass)',
               xlabel=f'lateral distance of a pass from the centre of the sensors [{unit}]')
    for axes in (top, middle, bottom):
        axes.grid(alpha=0.3)
    return figure


def _draw_map(plan: Plan, title: str) -> tuple[Figure, Axes, float, str]:
    """Draw a map with the sensors and the lanes; return figure, axes, length factor and unit."""
    f, unit = style.scale_of(np.ptp(plan.x))
    figure = Figure(figsize=(8.0, 6.8), layout='constrained')
    axes = figure.add_subplot()
    axes.set(aspect='equal', xlabel=f'x [{unit}]', ylabel=f'y [{unit}]',
             xlim=(f * plan.x[0], f * plan.x[-1]), ylim=(f * plan.y[0], f * plan.y[-1]))
    axes.set_title(title, fontsize=11)
    for inside in _lane_points(plan, f):
        axes.plot(*inside.T, '--', color='0.25', lw=0.8)
        if len(inside) > 3:
            axes.annotate('', inside[-1], inside[-4],
                          arrowprops={'arrowstyle': '-|>', 'color': '0.25'})
    axes.plot(*(f * plan.network.positions[:, :2]).T, 'k^', ms=8, mec='w', zorder=5)
    return figure, axes, f, unit


def _lane_points(plan: Plan, f: float) -> list[FloatArray]:
    """Points (n, 2) of each lane on the map, scaled by `f`."""
    low, high = (plan.x[0], plan.y[0]), (plan.x[-1], plan.y[-1])
    return [f * lane.points[((lane.points >= low) & (lane.points <= high)).all(axis=1)]
            for lane in plan.lanes]


def _gain(plan: Plan, f: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coordinates scaled by `f`, and reduction [%] of the bound by a sensor at each point."""
    gain = 100.0 * (1.0 - plan.std_with_added_sensor / plan.std_without_added_sensor)
    return (f * np.linspace(plan.x[0], plan.x[-1], gain.shape[1]),
            f * np.linspace(plan.y[0], plan.y[-1], gain.shape[0]), gain)


def length_text(metres: float) -> str:
    """Length in a readable unit."""
    return f'{metres:.3g} m' if metres >= 0.01 else f'{1e3 * metres:.2g} mm'


def _distinct_lanes(lanes: Sequence[Lane]) -> list[tuple[str, Lane]]:
    """Group lanes with identical curves: their combined names, and the first lane."""
    out: list[tuple[list[str], Lane]] = []
    for lane in lanes:
        for names, other in out:
            if all(np.array_equal(a.shape, b.shape) and np.allclose(a, b, rtol=1e-3) for a, b in (
                    (lane.along, other.along), (lane.filter_std, other.filter_std),
                    (lane.pass_std, other.pass_std), (lane.detection, other.detection))):
                names.append(style.literal(lane.name))
                break
        else:
            out.append(([style.literal(lane.name)], lane))
    return [(' and '.join(names), lane) for names, lane in out]


def write_report(plan: Plan, lines: list[str], out: Path) -> None:
    """Write the report of a plan, with its `summary_lines`, to `report.html`."""
    network = plan.network
    page.Page(
        f'Plan for {quantity(len(network), "sensor")}',
        f'target with {plan.target.moment:g} A m^2 at {plan.target.speed:g} m/s',
        [page.Note(page.NOTE, line.strip()) for line in lines], None, [*_maps(plan), *_lanes(plan)],
        [page.Table('Sensors', ['sensor', 'x [m]', 'y [m]', 'z [m]'],
                    [[name, *map(float, position)] for name, position in zip(
                        network.names, network.positions, strict=True)])]).write(out / REPORT)


def summary_lines(p: Plan) -> list[str]:
    """Summarise a plan, one line per result."""
    noise, lines = float(np.median(p.sampling.noise_std)), list[str]()
    lines.append(f'{quantity(len(p.network), "sensor")}, {1e9 * noise:.2g} nT noise per frame; '
                 f'target with {p.target.moment:g} A m^2 at {p.target.speed:g} m/s')
    observability = p.observability
    observable = (f'not observable: {", ".join(observability.unobservable)}'
                  if observability.unobservable
                  else f'observable, condition number {observability.condition_number:.3g}')
    lines.append(f'single pass on lane {p.lanes[0].name}, without priors: {observable}')
    for name, (r, v, m) in p.bounds_at_closest.items():
        lines.append(f'  bounds at the closest point, {name}: position {length_text(r)}, '
                     f'velocity {v:.3g} m/s, moment {m:.3g} A m^2')
    for lane in p.lanes:
        detectable = np.flatnonzero(lane.detection >= GOOD_PD)
        first_text = 'nowhere'
        if len(detectable):
            along = lane.along[detectable[0]]
            first_text = f'at {abs(along):.3g} m {"past" if along > 0.0 else "before"} the centre'
        closest = int(np.argmin(np.abs(lane.along)))
        lines.append(f'lane {lane.name}: the detection probability of a frame reaches '
                     f'{GOOD_PD:.0%} {first_text}; position bound at the centre '
                     f'{length_text(lane.filter_std[closest])} (filter), '
                     f'{length_text(lane.pass_std[closest, 0])} (whole pass)')
    detected_offsets = p.miss_curve[p.miss_curve[:, 1] < 0.01, 0]
    lines.append(
        f'99% of passes are detected up to {detected_offsets.max():.3g} m from the centre'
        if len(detected_offsets) else 'the detection probability of a pass is below 99% everywhere')
    lines.append('(bounds for a point target; errors with real vehicles are several times larger)')
    if not np.isfinite(p.std_with_added_sensor).any():
        lines.append('additional sensor: no position in the area is far enough from the lanes')
    elif np.nanmin(p.std_with_added_sensor) > 0.99 * p.std_without_added_sensor:
        lines.append('additional sensor: no improvement anywhere in the area')
    else:
        x, y = p.best_position
        remark = ' (on the edge of the area)' if x in p.x[[0, -1]] or y in p.y[[0, -1]] else ''
        lines.append(f'additional sensor: best at ({x:.2f}, {y:.2f}) m{remark}, where the median '
                     'bound near the sensors is '
                     f'{length_text(np.nanmin(p.std_with_added_sensor))} instead of '
                     f'{length_text(p.std_without_added_sensor)}')
    return lines


def _maps(plan: Plan) -> list[page.Chart]:
    f, unit = style.scale_of(np.ptp(plan.x))
    layout = page.axes(f'x [{unit}]', f'y [{unit}]', is_map=True)
    x, y = f * plan.x, f * plan.y
    bound = np.log10(f * np.clip(plan.position_std, None, np.ptp(plan.x)))
    low, high = np.nanquantile(bound, [LOW_QUANTILE, 1.0 - LOW_QUANTILE])
    position = page.heat_map(x, y, bound, 'Viridis', f'standard deviation [{unit}]', float(low),
                        float(high))
    # The colour bar labels the logarithmic values with linear numbers.
    ticks = [v for v in ROUND_NUMBERS if low <= np.log10(v) <= high] or [10.0**(0.5 * (low + high))]
    position['colorbar'] |= {'tickvals': np.log10(ticks).tolist(),
                             'ticktext': [f'{v:.3g}' for v in ticks]}
    position |= {'text': [[f'{10.0**v:.3g} {unit}' for v in row] for row in bound],
                 'hoverinfo': 'x+y+text'}
    gain_x, gain_y, gain = _gain(plan, f)
    site = _site_traces(plan, f)
    charts = [page.Chart('Position bound from a whole pass', [position, *site], layout),
              page.Chart('Probability that one frame detects the target', [page.heat_map(
                  x, y, plan.detection, 'Cividis', 'probability', 0.0, 1.0), *site], layout)]
    if np.isfinite(gain).any():
        charts.append(page.Chart('Gain of an additional sensor', [
            page.heat_map(gain_x, gain_y, gain, 'Cividis', 'reduction [%]'), *site,
            {'type': 'scatter', 'mode': 'markers', 'x': [f * plan.best_position[0]],
             'y': [f * plan.best_position[1]], 'name': 'best position', 'hoverinfo': 'name+x+y',
             'marker': {'symbol': 'star', 'size': 15, 'color': style.VERMILLION,
                        'line': {'color': '#ffffff', 'width': 1}}}], layout))
    return charts


def _site_traces(plan: Plan, f: float) -> list[dict[str, Any]]:
    """Traces of the lanes and sensors on a map whose coordinates are scaled by `f`."""
    traces: list[dict[str, Any]] = [
        {'type': 'scatter', 'mode': 'lines', 'x': points[:, 0].tolist(),
         'y': points[:, 1].tolist(), 'hoverinfo': 'skip', 'showlegend': False,
         'line': {'color': '#ffffff', 'dash': 'dash', 'width': 1.5}}
        for points in _lane_points(plan, f)]
    return [*traces, page.sensor_trace(f * plan.network.positions, plan.network.names)]


def _lanes(plan: Plan) -> list[page.Chart]:
    f, unit = style.scale_of(np.ptp(plan.x))
    bounds, detection = [], []
    for k, (name, lane) in enumerate(_distinct_lanes(plan.lanes)):
        along: FloatArray = f * lane.along
        bounds += [page.curve(along, f * lane.filter_std, f'{name}: filter so far', 2 * k),
                   page.curve(along, f * lane.pass_std[:, 0], f'{name}: whole pass', 2 * k + 1)]
        detection.append(page.curve(along, lane.detection, name, k))
    missed_passes = plan.miss_curve[plan.miss_curve[:, 1] >= MIN_MISSED]
    label = f'distance along the lane from the point nearest to the centre [{unit}]'
    misses = page.curve(f * missed_passes[:, 0], missed_passes[:, 1], '', 0, 'lines+markers')
    return [
        page.Chart('Position bound along the lanes', bounds,
                   page.axes(label, f'standard deviation [{unit}]', log_y=True)),
        page.Chart('Detection along the lanes', detection,
                   page.axes(label, 'probability per frame')),
        page.Chart('Missed passes', [misses], page.axes(
            f'lateral distance from the centre of the sensors [{unit}]', 'probability of a miss',
            log_y=True))]
