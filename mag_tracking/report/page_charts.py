"""Plotly charts in the palette of the figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.report.palette import SERIES_COLOURS

DASHES = ('solid', 'dash', 'dot', 'dashdot', 'longdash')
"""Dash styles, one for each colour."""


def escape_markup(text: str) -> str:
    """Escape the markup characters of Plotly."""
    return text.replace('&', '&amp;').replace('<', '&lt;').replace('>', '&gt;')


def numbers(values: ArrayLike) -> list[Any]:
    """Nested lists of an array's numbers with ten digits; non-finite values become None."""
    array = np.asarray(values, dtype=float)
    if array.ndim > 1:
        return [numbers(row) for row in array]
    return [float(f'{v:.10g}') if np.isfinite(v) else None for v in array]


def curve(x: ArrayLike, y: ArrayLike, name: str, k: int, mode: str = 'lines') -> dict[str, Any]:
    """Plotly trace of a curve; `k` is the index of its colour and dash style.

    An empty `name` omits the legend entry.
    """
    colour = SERIES_COLOURS[k % len(SERIES_COLOURS)]
    return {'type': 'scatter', 'mode': mode, 'x': numbers(x), 'y': numbers(y),
            'name': escape_markup(name), 'showlegend': bool(name),
            'line': {'color': colour, 'dash': DASHES[k % len(DASHES)], 'width': 2},
            'marker': {'color': colour, 'size': 6}}


def heat_map(x: FloatArray, y: FloatArray, z: FloatArray, scale: str, title: str,
             low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """Plotly trace of a heat map `z` (n_y, n_x), with `title` beside the colour bar.

    `scale` is a Plotly colour scale, preferably a perceptually uniform one; `low` and `high` are
    its limits, by default those of `z`.
    """
    return {'type': 'heatmap', 'x': numbers(x), 'y': numbers(y), 'z': numbers(z),
            'colorscale': scale, 'zmin': low, 'zmax': high, 'hoverongaps': False,
            # The padding contains the buttons, as the right margin of `map.js`.
            'colorbar': {'title': {'text': title, 'side': 'right'}, 'x': 1.0, 'xpad': 42}}


def sensor_trace(points: FloatArray, names: Sequence[str]) -> dict[str, Any]:
    """Plotly trace of the sensors on a map; `points` are in the unit of the map."""
    return {'type': 'scatter', 'mode': 'markers', 'x': numbers(points[:, 0]),
            'y': numbers(points[:, 1]), 'text': [escape_markup(name) for name in names],
            'hoverinfo': 'text', 'name': 'magnetometers', 'showlegend': False,
            'marker': {'symbol': 'triangle-up', 'size': 11, 'color': '#ffffff',
                       'line': {'color': '#000000', 'width': 1.5}}}


def axes(x: str, y: str, is_map: bool = False, log_y: bool = False) -> dict[str, Any]:
    """Plotly layout with axis titles; both axes of a map have the same scale."""
    grid = {'gridcolor': '#e3e3e3', 'zeroline': False, 'exponentformat': 'none',
            'automargin': True}
    return {'xaxis': {'title': {'text': x}, **grid, **({'constrain': 'domain'} if is_map else {})},
            'yaxis': {'title': {'text': y}, **grid,
                      **({'scaleanchor': 'x', 'constrain': 'domain'} if is_map else {}),
                      **({'type': 'log'} if log_y else {})}}
