"""The page of a report and of the live view: one HTML file that needs nothing else.

Its parts are in the folder `page`; the plotting library is that of the package plotly.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib import resources
from typing import Any

SCRIPTS = ('scene', 'map', 'curves', 'tables', 'live', 'main', 'start')
"""Parts of the script, in their order."""
REPORT = 'report.html'
"""Name of a report in a folder of results."""
ERROR, WARNING, NOTE = 'error', 'warning', 'note'
"""Levels of a note."""


@dataclass(frozen=True, slots=True)
class Note:
    """One sentence at the head of a page."""

    level: str
    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """A table; numbers are shown with four digits, None as a dash."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves or a map that do not depend on the time shown."""

    title: str
    traces: Sequence[Mapping[str, Any]]
    """In the terms of Plotly."""
    layout: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Page:
    """What a page shows."""

    title: str
    subtitle: str = ''
    notes: Sequence[Note] = ()
    scene: Mapping[str, Any] | None = None
    """A map over time: what `page_scene.scene_of` gives."""
    charts: Sequence[Chart] = ()
    tables: Sequence[Table] = ()


def report_html(page: Page) -> str:
    """A whole HTML file, without anything from outside."""
    return _html(page.title, asdict(page))


def live_html() -> str:
    """The page that gets its data from the WebSocket `stream` beside it."""
    return _html('mag_tracking', {'title': 'mag_tracking', 'live': True})


def _html(title: str, data: Mapping[str, Any]) -> str:
    """The template with its parts.

    Within a script only the characters of a closing tag matter: they are escaped in the data.
    """
    folder = resources.files('mag_tracking.report') / 'page'
    plotly = resources.files('plotly') / 'package_data' / 'plotly.min.js'
    script = '\n'.join(_text(folder / f'{name}.js') for name in SCRIPTS)
    # The data comes last: it may contain what looks like another mark.
    parts = (('@TITLE@', escape(title)), ('@STYLE@', _text(folder / 'page.css')),
             ('@PLOTLY@', _text(plotly)), ('@SCRIPT@', script),
             ('@DATA@', json.dumps(data, allow_nan=False).replace('<', '\\u003c')))
    out, rest = [], _text(folder / 'page.html')
    by_place = sorted(parts, key=lambda part: rest.index(part[0]))
    for mark, text in by_place:
        before, rest = rest.split(mark, 1)
        out += [before, text]
    return ''.join([*out, rest])


def _text(path: Any) -> str:
    """The text of a file of a package."""
    text: str = path.read_text(encoding='utf-8')
    return text
