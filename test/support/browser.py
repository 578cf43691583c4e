"""Headless Chromium for tests of web pages."""

import contextlib
import shutil
import time

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')


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
        self.page.on('request', lambda request: self.requests.append(request.url))
        self.page.goto(url)

    def _record_message(self, message):
        if message.type in ('error', 'warning'):
            self.page_errors.append(message.text)

    def value(self, expression):
        """Evaluate a JavaScript expression in the page, and return its value."""
        return self.page.evaluate(expression)

    def wait(self, expression, seconds=60.0):
        """Wait until a JavaScript expression is true; fail after `seconds`."""
        # Playwright's wait function uses `eval`, which the security policy of the page forbids.
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f'{expression} has not become true'
            self.page.wait_for_timeout(20)

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

    def line_times(self):
        """Times [s] of the vertical lines that mark the current time, one per plot."""
        return self.value('''[...document.querySelectorAll('#field .plot'),
            ...['weights', 'innovation', 'speed'].map(id => document.getElementById(id))]
            .map(plot => plot.layout.shapes[0].x0)''')
