"""Self-contained HTML pages of reports and of the live view.

The template and the scripts are in the folder `page`. The folder `plotly` contains the bundle
plotly.js-cartesian-dist-min of npm, a third of the size of the bundle with all chart types.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib import resources
from typing import Any

from mag_tracking.report.json_text import json_text

SCRIPTS = ('scene', 'map', 'body', 'overview', 'curves', 'tables', 'live', 'main', 'start')
"""Script files, in loading order."""
REPORT = 'report.html'
"""File name of the report in a result folder."""
ERROR, WARNING, NOTE = 'error', 'warning', 'note'
"""Severities of a note."""


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
    """Plotly traces."""
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


def report_html(page: Page) -> str:
    """Report as HTML that loads no external resources."""
    return _html(page.title, asdict(page))


def live_html() -> str:
    """HTML of the live page, which receives its data from the WebSocket `stream`."""
    return _html('mag_tracking', {'title': 'mag_tracking', 'live': True})


def _html(title: str, data: Mapping[str, Any]) -> str:
    """Fill title, style, scripts and data into the template.

    In the data, `<` is escaped so that no string can close the script element.
    """
    report = resources.files('mag_tracking.report')
    folder, plotly = report / 'page', report / 'plotly' / 'plotly-cartesian.min.js'
    script = '\n'.join(_read(folder / f'{name}.js') for name in SCRIPTS)
    parts = (('@TITLE@', escape(title)), ('@STYLE@', _read(folder / 'page.css')),
             ('@PLOTLY@', _read(plotly)), ('@SCRIPT@', script),
             ('@DATA@', json_text(data).replace('<', '\\u003c')))
    out, remaining = [], _read(folder / 'page.html')
    ordered_parts = sorted(parts, key=lambda part: remaining.index(part[0]))
    for placeholder, text in ordered_parts:
        before, remaining = remaining.split(placeholder, 1)
        out += [before, text]
    return ''.join([*out, remaining])


def _read(path: Any) -> str:
    """Read a text file of the package."""
    text: str = path.read_text(encoding='utf-8')
    return text
