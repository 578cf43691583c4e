"""Headless Chromium, as people open a page, for tests."""

import contextlib
import shutil
import time

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')


def chromium():
    """The path of a browser, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


needs_browser = pytest.mark.skipif(chromium() is None, reason='there is no Chromium here')


@contextlib.contextmanager
def browser():
    """A browser of Playwright."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # In a container root may not make a sandbox; the pages are our own.
        # Its shared memory is small there, too.
        found = playwright.chromium.launch(executable_path=chromium(), args=[
            '--no-sandbox', '--disable-dev-shm-usage'])
        try:
            yield found
        finally:
            found.close()


class Page:
    """A page, and what its console has said."""

    def __init__(self, browser, url, **options):
        self.page = browser.new_page(**options)
        self.complaints = []
        self.page.on('console', self._heard)
        self.page.on('pageerror', lambda error: self.complaints.append(str(error)))
        self.requests = []
        self.page.on('request', lambda request: self.requests.append(request.url))
        self.page.goto(url)

    def _heard(self, message):
        if message.type in ('error', 'warning'):
            self.complaints.append(message.text)

    def value(self, expression):
        """Value of a JavaScript expression."""
        return self.page.evaluate(expression)

    def wait(self, expression, seconds=60.0):
        """Wait until JavaScript gives something true.

        Playwright's own function to wait evaluates text, which the page does not allow.
        """
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f'{expression} has not become true'
            self.page.wait_for_timeout(20)

    def move_slider(self, t):
        """Move it as a hand does, and wait until that is drawn."""
        drawn = self.value('magTracking.drawn')
        self.page.evaluate(
            't => { const s = document.getElementById("slider"); s.value = t;'
            ' s.dispatchEvent(new Event("input")); }', t)
        self.wait(f'magTracking.drawn > {drawn}')

    def pose_on_map(self):
        """(x, y) of the pose on the map, in map units; None if no pose is shown."""
        return self.value('''(() => {
            const pose = document.getElementById('map').data.find(d => d.meta === 'pose');
            return pose ? [pose.x[0], pose.y[0]] : null; })()''')

    def lines(self):
        """The times at which the curves have their lines."""
        return self.value('''[...document.querySelectorAll('#field .plot'),
            ...['weights', 'innovation', 'speed'].map(id => document.getElementById(id))]
            .map(plot => plot.layout.shapes[0].x0)''')
