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
    """Escape the markup characters of Plotly.

    Parameters
    ----------
    text : str

    Returns
    -------
    str
    """
    return text.replace('&', '&amp;').replace('<', '&lt;').replace('>', '&gt;')


def numbers(values: ArrayLike) -> list[Any]:
    """Convert an array to nested lists of numbers with ten digits; non-finite values become None.

    Parameters
    ----------
    values : (...) array

    Returns
    -------
    list
    """
    array = np.asarray(values, dtype=float)
    if array.ndim > 1:
        return [numbers(row) for row in array]
    return [float(f'{v:.10g}') if np.isfinite(v) else None for v in array]


def curve(x: ArrayLike, y: ArrayLike, name: str, k: int, mode: str = 'lines') -> dict[str, Any]:
    """Create the Plotly trace of a curve.

    Parameters
    ----------
    x, y : (n,) array
    name : str
        Legend entry. An empty string omits the entry.
    k : int
        Index of the colour and the dash style.
    mode : str
        Plotly mode, for example 'lines+markers'.

    Returns
    -------
    dict
    """
    colour = SERIES_COLOURS[k % len(SERIES_COLOURS)]
    return {'type': 'scatter', 'mode': mode, 'x': numbers(x), 'y': numbers(y),
            'name': escape_markup(name), 'showlegend': bool(name),
            'line': {'color': colour, 'dash': DASHES[k % len(DASHES)], 'width': 2},
            'marker': {'color': colour, 'size': 6}}


def heat_map(x: FloatArray, y: FloatArray, z: FloatArray, scale: str, title: str,
             low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """Create the Plotly trace of a heat map.

    Parameters
    ----------
    x : (n_x,) array
    y : (n_y,) array
    z : (n_y, n_x) array
    scale : str
        Name of a Plotly colour scale, preferably a perceptually uniform one.
    title : str
        Title of the colour bar.
    low, high : float, optional
        Limits of the colour scale; by default the minimum and maximum of `z`.

    Returns
    -------
    dict
    """
    return {'type': 'heatmap', 'x': numbers(x), 'y': numbers(y), 'z': numbers(z),
            'colorscale': scale, 'zmin': low, 'zmax': high, 'hoverongaps': False,
            # The padding contains the buttons, as the right margin of `map.js`.
            'colorbar': {'title': {'text': title, 'side': 'right'}, 'x': 1.0, 'xpad': 42}}


def sensor_trace(points: FloatArray, names: Sequence[str]) -> dict[str, Any]:
    """Create the Plotly trace of the sensors on a map.

    Parameters
    ----------
    points : (n, 2) or (n, 3) array
        Sensor positions in the unit of the map.
    names : sequence of str

    Returns
    -------
    dict
    """
    return {'type': 'scatter', 'mode': 'markers', 'x': numbers(points[:, 0]),
            'y': numbers(points[:, 1]), 'text': [escape_markup(name) for name in names],
            'hoverinfo': 'text', 'name': 'magnetometers', 'showlegend': False,
            'marker': {'symbol': 'triangle-up', 'size': 11, 'color': '#ffffff',
                       'line': {'color': '#000000', 'width': 1.5}}}


def axes(x: str, y: str, is_map: bool = False, log_y: bool = False) -> dict[str, Any]:
    """Create a Plotly layout with axis titles.

    Parameters
    ----------
    x, y : str
        Axis titles.
    is_map : bool
        Whether both axes have the same scale.
    log_y : bool
        Whether the y axis is logarithmic.

    Returns
    -------
    dict
    """
    grid = {'gridcolor': '#e3e3e3', 'zeroline': False, 'exponentformat': 'none',
            'automargin': True}
    return {'xaxis': {'title': {'text': x}, **grid, **({'constrain': 'domain'} if is_map else {})},
            'yaxis': {'title': {'text': y}, **grid,
                      **({'scaleanchor': 'x', 'constrain': 'domain'} if is_map else {}),
                      **({'type': 'log'} if log_y else {})}}
