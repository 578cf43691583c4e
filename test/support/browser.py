"""Headless Chromium for tests of web pages."""

import contextlib
import shutil
import time
from urllib.parse import urlsplit

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')
BUTTONS = {'Download plot as a PNG', 'Zoom', 'Pan', 'Zoom in', 'Zoom out', 'Reset axes', 'Play',
           'Latest', 'Show this track'}
"""Labels of all buttons of the pages. None of them sends data to another machine."""


def chromium():
    """Path of the first Chromium browser on PATH, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


needs_browser = pytest.mark.skipif(chromium() is None, reason='Chromium is not installed')


@contextlib.contextmanager
def browser():
    """Open a Playwright browser, and close it afterwards."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # In a container, root cannot create a sandbox, and shared memory is small. The pages are
        # trusted.
        opened = playwright.chromium.launch(executable_path=chromium(), args=[
            '--no-sandbox', '--disable-dev-shm-usage'])
        try:
            yield opened
        finally:
            opened.close()


class Page:
    """Page opened in a browser; records its console errors and its requests."""

    def __init__(self, browser, url, **options):
        self.page = browser.new_page(**options)
        self.page_errors = []
        self.page.on('console', self._record_message)
        self.page.on('pageerror', lambda error: self.page_errors.append(str(error)))
        self.requests = []
        # The context also reports the requests of windows that the page opens.
        self.page.context.on('request', lambda request: self.requests.append(request.url))
        self.page.on('websocket', lambda socket: self.requests.append(socket.url))
        self.url = url
        self.page.goto(url)

    def _record_message(self, message):
        if message.type in ('error', 'warning'):
            self.page_errors.append(message.text)

    def value(self, expression, argument=None):
        """Evaluate a JavaScript expression or function in the page, and return its value."""
        return self.page.evaluate(expression, argument)

    def wait(self, expression, seconds=240.0):
        """Wait until a JavaScript expression is true; fail after `seconds`."""
        # Playwright's wait function uses `eval`, which the security policy of the page forbids.
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f'{expression} has not become true'
            self.page.wait_for_timeout(20)

    def assert_private(self):
        """Assert that all buttons are known, and that none of them requests another origin."""
        found = self.value('''[...document.querySelectorAll('button, a[href], form, [role=button]')]
            .map(e => e.dataset.title || e.title || e.ariaLabel || e.textContent)''')
        assert {*found} <= BUTTONS
        self.value('''[...document.querySelectorAll('button')]
            .filter(e => e.checkVisibility()).forEach(e => e.click())''')
        self.page.wait_for_timeout(100)
        assert len(self.page.context.pages) == 1
        own = urlsplit(self.url)
        assert [url for url in self.requests if urlsplit(url).scheme not in ('blob', 'data')
                and (urlsplit(url).netloc != own.netloc
                     or own.scheme == 'file' and url != self.url)] == []

    def assert_complete(self):
        """Assert that each plot has content of known types, and that no button covers it."""
        empty, covered, unknown = self.value('''(() => {
            const shown = [...document.querySelectorAll('.js-plotly-plot')]
              .filter(plot => plot.checkVisibility());
            const name = plot => plot.id || plot.closest('.card').innerText;
            const overlaps = (a, b) => a.left < b.right && b.left < a.right
              && a.top < b.bottom && b.top < a.bottom;
            const parts = '.nsewdrag, .legend, .g-xtitle, .g-ytitle, .cbtitle, .cbaxis, .xtick';
            return [
              shown.filter(plot => !plot.data.some(d => Array.from(d.y).some(v => v !== null)))
                .map(name),
              shown.filter(plot => [...plot.querySelectorAll('.modebar-group')].some(group =>
                [...plot.querySelectorAll(parts)].some(part => overlaps(
                  group.getBoundingClientRect(), part.getBoundingClientRect())))).map(name),
              // Plotly draws an unknown type of trace as another one.
              shown.filter(plot => plot.data.some((d, i) => d.type !== plot._fullData[i].type))
                .map(name)];
            })()''')
        assert empty == [] and covered == [] and unknown == []

    def move_slider(self, t):
        """Move the slider to time `t` [s] as a user does, and wait until the page is redrawn."""
        drawn = self.value('magTracking.drawn')
        self.page.evaluate(
            't => { const s = document.getElementById("slider"); s.value = t;'
            ' s.dispatchEvent(new Event("input")); }', t)
        self.wait(f'magTracking.drawn > {drawn}')

    def pose_on_map(self):
        """Position (x, y) of the pose on the map, in map units; None if no pose is shown."""
        return self.value('''(() => {
            const pose = document.getElementById('map').data.find(d => d.meta === 'pose');
            return pose ? [pose.x[0], pose.y[0]] : null; })()''')

    def is_within_map(self, names):
        """Whether the traces of the map with these names or `meta` are within its axes."""
        return self.value('''names => { const map = document.getElementById('map');
            const [[x0, x1], [y0, y1]] = ['xaxis', 'yaxis'].map(a => map._fullLayout[a].range);
            const traces = map.data.filter(d => names.includes(d.name) || names.includes(d.meta));
            return traces.length >= names.length && traces.every(d =>
              d.x.every(x => x === null || x0 <= x && x <= x1)
              && d.y.every(y => y === null || y0 <= y && y <= y1)); }''', names)

    def line_times(self):
        """Times [s] of the vertical lines that mark the current time, one per plot."""
        return self.value('''[...document.querySelectorAll('#field .plot'),
            ...['weights', 'innovation', 'speed'].map(id => document.getElementById(id))]
            .map(plot => plot.layout.shapes[0].x0)''')
