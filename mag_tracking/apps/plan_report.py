"""Report of a plan: maps of accuracy and detection, and curves along the lanes."""

from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.apps.plan import GOOD_PD, Plan
from mag_tracking.arrays import FloatArray
from mag_tracking.files import replace_text
from mag_tracking.quantities import quantity
from mag_tracking.report.page import NOTE, REPORT, Chart, Note, Page, Table, report_html
from mag_tracking.report.page_charts import axes, curve, heat_map, sensor_trace
from mag_tracking.report.plan_figures import MIN_MISSED, distinct_lanes, length_text
from mag_tracking.report.scales import scale_of

LOW_QUANTILE = 0.02
"""Quantile of a bound at the lower end of its colour scale; the upper end is symmetric."""


def write_report(plan: Plan, lines: list[str], out: Path) -> Path:
    """Write the report of a plan, with its `summary_lines`, to `report.html`."""
    path = out / REPORT
    replace_text(path, report_html(plan_page(plan, lines)))
    return path


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


def plan_page(plan: Plan, lines: list[str]) -> Page:
    """Create the page of a plan with its `summary_lines`."""
    network = plan.network
    return Page(f'Plan for {quantity(len(network), "sensor")}',
                f'target with {plan.target.moment:g} A m^2 at {plan.target.speed:g} m/s',
                [Note(NOTE, line.strip()) for line in lines], None,
                [*_maps(plan), *_lanes(plan)],
                [Table('Sensors', ['sensor', 'x [m]', 'y [m]', 'z [m]'],
                       [[name, *map(float, position)] for name, position in zip(
                           network.names, network.positions, strict=True)])])


def _maps(plan: Plan) -> list[Chart]:
    """Maps of position bound, detection probability and gain of an additional sensor."""
    f, unit = scale_of(np.ptp(plan.x))
    layout = axes(f'x [{unit}]', f'y [{unit}]', is_map=True)
    x, y = f * plan.x, f * plan.y
    bound = np.log10(f * np.clip(plan.position_std, None, np.ptp(plan.x)))
    low, high = np.nanquantile(bound, [LOW_QUANTILE, 1.0 - LOW_QUANTILE])
    position = heat_map(x, y, bound, 'Viridis', f'standard deviation [{unit}]', float(low),
                        float(high))
    position['colorbar'] |= _log_ticks(low, high)
    position |= {'text': [[f'{10.0**v:.3g} {unit}' for v in row] for row in bound],
                 'hoverinfo': 'x+y+text'}
    gain = 100.0 * (1.0 - plan.std_with_added_sensor / plan.std_without_added_sensor)
    ny, nx = gain.shape
    charts = [Chart('Position bound from a whole pass', [position, *_site_traces(plan, f)], layout),
              Chart('Probability that one frame detects the target', [
                  heat_map(x, y, plan.detection, 'Cividis', 'probability', 0.0, 1.0),
                  *_site_traces(plan, f)], layout)]
    if np.isfinite(gain).any():
        charts.append(Chart('Gain of an additional sensor', [
            heat_map(np.linspace(x[0], x[-1], nx), np.linspace(y[0], y[-1], ny), gain, 'Cividis',
                     'reduction [%]'), *_site_traces(plan, f),
            {'type': 'scatter', 'mode': 'markers', 'x': [f * plan.best_position[0]],
             'y': [f * plan.best_position[1]], 'name': 'best position', 'hoverinfo': 'name+x+y',
             'marker': {'symbol': 'star', 'size': 15, 'color': '#D55E00',
                        'line': {'color': '#ffffff', 'width': 1}}}], layout))
    return charts


def _log_ticks(low: float, high: float) -> dict[str, Any]:
    """Create the ticks of a colour bar that label logarithmic values with linear numbers."""
    steps = [10.0**k * m for k in range(-7, 8) for m in (1, 2, 5)]
    ticks = [v for v in steps if low <= np.log10(v) <= high] or [10.0 ** (0.5 * (low + high))]
    return {'tickvals': np.log10(ticks).tolist(), 'ticktext': [f'{v:.3g}' for v in ticks]}


def _site_traces(plan: Plan, f: float) -> list[dict[str, Any]]:
    """Traces of the lanes and sensors on a map whose coordinates are scaled by `f`."""
    low, high = (plan.x[0], plan.y[0]), (plan.x[-1], plan.y[-1])
    traces = []
    for lane in plan.lanes:
        points_inside = f * lane.points[((lane.points >= low) & (lane.points <= high)).all(axis=1)]
        traces.append({'type': 'scatter', 'mode': 'lines', 'x': points_inside[:, 0].tolist(),
                       'y': points_inside[:, 1].tolist(), 'hoverinfo': 'skip', 'showlegend': False,
                       'line': {'color': '#ffffff', 'dash': 'dash', 'width': 1.5}})
    return [*traces, sensor_trace(f * plan.network.positions, plan.network.names)]


def _lanes(plan: Plan) -> list[Chart]:
    """Charts of position bound and detection probability along the lanes, and of missed passes."""
    f, unit = scale_of(np.ptp(plan.x))
    bounds, detection = [], []
    for k, (name, lane) in enumerate(distinct_lanes(plan.lanes)):
        along: FloatArray = f * lane.along
        bounds += [curve(along, f * lane.filter_std, f'{name}: filter so far', 2 * k),
                   curve(along, f * lane.pass_std[:, 0], f'{name}: whole pass', 2 * k + 1)]
        detection.append(curve(along, lane.detection, name, k))
    missed_passes = plan.miss_curve[plan.miss_curve[:, 1] >= MIN_MISSED]
    label = f'distance along the lane from the point nearest to the centre [{unit}]'
    return [Chart('Position bound along the lanes', bounds,
                  axes(label, f'standard deviation [{unit}]', log_y=True)),
            Chart('Detection along the lanes', detection, axes(label, 'probability per frame')),
            Chart('Missed passes', [curve(f * missed_passes[:, 0], missed_passes[:, 1], '', 0,
                                          'lines+markers')],
                  axes(f'lateral distance from the centre of the sensors [{unit}]',
                       'probability of a miss', log_y=True))]
