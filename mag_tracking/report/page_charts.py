"""Plotly charts in the palette of the figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.report.palette import SERIES

DASHES = ('solid', 'dash', 'dot', 'dashdot', 'longdash')
"""Dash styles, one per colour."""


def plain(text: str) -> str:
    """Text with the markup characters of Plotly escaped."""
    return text.replace('&', '&amp;').replace('<', '&lt;').replace('>', '&gt;')


def numbers(values: ArrayLike) -> list[Any]:
    """Nested lists of numbers; non-finite values become None."""
    array = np.asarray(values, dtype=float)
    if array.ndim > 1:
        return [numbers(row) for row in array]
    return [float(f'{v:.10g}') if np.isfinite(v) else None for v in array]


def curve(x: ArrayLike, y: ArrayLike, name: str, k: int, mode: str = 'lines') -> dict[str, Any]:
    """Curve in the `k`-th colour and dash style."""
    colour = SERIES[k % len(SERIES)]
    return {'type': 'scatter', 'mode': mode, 'x': numbers(x), 'y': numbers(y),
            'name': plain(name), 'showlegend': bool(name),
            'line': {'color': colour, 'dash': DASHES[k % len(DASHES)], 'width': 2},
            'marker': {'color': colour, 'size': 6}}


def heat_map(x: FloatArray, y: FloatArray, z: FloatArray, scale: str, title: str,
             low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """Heat map of z (n_y, n_x) in a perceptually uniform colour scale."""
    return {'type': 'heatmap', 'x': numbers(x), 'y': numbers(y), 'z': numbers(z),
            'colorscale': scale, 'zmin': low, 'zmax': high, 'hoverongaps': False,
            'colorbar': {'title': {'text': title, 'side': 'right'}}}


def places(points: FloatArray, names: Sequence[str]) -> dict[str, Any]:
    """Sensors on a map; `points` is (n, 2 or 3) [m]."""
    return {'type': 'scatter', 'mode': 'markers', 'x': numbers(points[:, 0]),
            'y': numbers(points[:, 1]), 'text': [plain(name) for name in names],
            'hoverinfo': 'text', 'name': 'magnetometers', 'showlegend': False,
            'marker': {'symbol': 'triangle-up', 'size': 11, 'color': '#ffffff',
                       'line': {'color': '#000000', 'width': 1.5}}}


def axes(x: str, y: str, is_map: bool = False, log_y: bool = False) -> dict[str, Any]:
    """Layout with axis titles; the axes of a map have the same scale."""
    grid = {'gridcolor': '#e3e3e3', 'zeroline': False, 'exponentformat': 'none',
            'automargin': True}
    return {'xaxis': {'title': {'text': x}, **grid, **({'constrain': 'domain'} if is_map else {})},
            'yaxis': {'title': {'text': y}, **grid,
                      **({'scaleanchor': 'x', 'constrain': 'domain'} if is_map else {}),
                      **({'type': 'log'} if log_y else {})}}
