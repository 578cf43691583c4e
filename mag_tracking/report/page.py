"""Self-contained HTML pages of reports and of the live view, and their Plotly charts.

The template and the scripts are in the folder `page`. The folder `plotly` contains the bundle
plotly.js-cartesian-dist-min of npm, a third of the size of the bundle with all chart types.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib import resources
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.files import json_text, replace_text
from mag_tracking.report.style import series_colour

SCRIPTS = ('scene', 'map', 'body', 'overview', 'curves', 'tables', 'live', 'main', 'start')
"""Script files, in loading order."""
ERROR, WARNING, NOTE = 'error', 'warning', 'note'
DASHES = ('solid', 'dash', 'dot', 'dashdot', 'longdash')


@dataclass(frozen=True, slots=True)
class Note:
    """Message at the top of a page."""

    level: str
    """One of `ERROR`, `WARNING` and `NOTE`."""
    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Table of a page; numbers are shown with four significant digits, None as a dash."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]


@dataclass(frozen=True, slots=True)
class Chart:
    """Static Plotly chart."""

    title: str
    traces: Sequence[Mapping[str, Any]]
    layout: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Page:
    """Content of a page."""

    title: str
    subtitle: str = ''
    notes: Sequence[Note] = ()
    scene: Mapping[str, Any] | None = None
    """Map with a time slider, as returned by `page_scene.scene_of`."""
    charts: Sequence[Chart] = ()
    tables: Sequence[Table] = ()

    def write(self, path: str | PathLike[str]) -> None:
        """Write the page as HTML; raises OutputError if it cannot be written."""
        replace_text(path, report_html(self))


def report_html(page: Page) -> str:
    """Report as HTML that loads no external resources."""
    return _html(page.title, asdict(page))


def live_html() -> str:
    """HTML of the live page, which receives its data from the WebSocket `stream`."""
    return _html('mag_tracking', {'title': 'mag_tracking', 'live': True})


def _html(title: str, data: Mapping[str, Any]) -> str:
    """Fill the template; in the data, `<` is escaped so that no string can close the script
    element."""
    def read(name: str) -> str:
        return (resources.files('mag_tracking.report') / name).read_text(encoding='utf-8')

    parts = {'TITLE': escape(title), 'STYLE': read('page/page.css'),
             'PLOTLY': read('plotly/plotly-cartesian.min.js'),
             'SCRIPT': '\n'.join(read(f'page/{name}.js') for name in SCRIPTS),
             'DATA': json_text(data).replace('<', '\\u003c')}
    texts = re.split('@([A-Z]+)@', read('page/page.html'))
    texts[1::2] = [parts[name] for name in texts[1::2]]
    return ''.join(texts)


def numbers(values: ArrayLike) -> list[Any]:
    """Nested lists of an array's numbers with ten digits; non-finite values become None."""
    array = np.asarray(values, dtype=float)
    if array.ndim > 1:
        return [numbers(row) for row in array]
    return [float(f'{v:.10g}') if np.isfinite(v) else None for v in array]


def curve(x: ArrayLike, y: ArrayLike, name: str, k: int, mode: str = 'lines') -> dict[str, Any]:
    """Plotly trace with the `k`-th colour and dash style; without name, without legend."""
    colour = series_colour(k)
    return {'type': 'scatter', 'mode': mode, 'x': numbers(x), 'y': numbers(y),
            'name': escape(name, quote=False), 'showlegend': bool(name),
            'line': {'color': colour, 'dash': DASHES[k % len(DASHES)], 'width': 2},
            'marker': {'color': colour, 'size': 6}}


def heat_map(x: FloatArray, y: FloatArray, z: FloatArray, scale: str, title: str,
             low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """Plotly trace of a heat map `z` (n_y, n_x) with a colour `scale` from `low` to `high`, by
    default those of `z`, and with `title` beside the colour bar."""
    return {'type': 'heatmap', 'x': numbers(x), 'y': numbers(y), 'z': numbers(z),
            'colorscale': scale, 'zmin': low, 'zmax': high, 'hoverongaps': False,
            # The padding contains the buttons, as the right margin of `map.js`.
            'colorbar': {'title': {'text': title, 'side': 'right'}, 'x': 1.0, 'xpad': 42}}


def sensor_trace(points: FloatArray, names: Sequence[str]) -> dict[str, Any]:
    """Plotly trace of the sensors on a map; `points` are in the unit of the map."""
    return {'type': 'scatter', 'mode': 'markers', 'x': numbers(points[:, 0]),
            'y': numbers(points[:, 1]), 'text': [escape(name, quote=False) for name in names],
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
