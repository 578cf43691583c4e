"""Delay of a live page, and effect of ten open pages on the latency with 100 sensors at 100 Hz.

    PYTHONPATH=test python -m bench.pages

The first figure is the delay from the timestamp of a pose to its drawing in Chromium. The aim is a
median of at most 200 ms. `bench.load` then runs alternately with and without the pages, because the
load of the machine varies. The second figure is the ratio of the 99 % quantiles of the latency. The
aim is a ratio of at most 1.1 without losses. If an aim is missed, the exit status is 1.
"""

import argparse
import sys
import threading
import time
from dataclasses import replace

import numpy as np

from bench.figures import Figures
from bench.load import measure
from mag_tracking.network.file import read_network
from mag_tracking.records import FieldFrame
from mag_tracking.web.live_scene import LiveScene
from mag_tracking.web.page_server import PageServer
from support.browser import Page, browser
from support.bundled import NETWORK_FILE
from support.live_records import poses, records_of

PAGES, MAX_WORSE = 10, 1.10
MAX_DELAY_MS = 200.0
RECORD_DELAYS = '''() => { window.delays = []; let before = 0; const look = () => {
    if (magTracking.drawn !== before && magTracking.latestDrawn) {
      before = magTracking.drawn;
      window.delays.push(Date.now() - Number(magTracking.latestDrawn) / 1e6); }
    requestAnimationFrame(look); }; look(); }'''


def drawing_delay():
    """Measure the median delay [ms] from the timestamp of a pose to its drawing."""
    network = read_network(NETWORK_FILE)
    records = records_of('straight_car_right', network)
    template = [r for r in records if isinstance(r, FieldFrame)][-1]
    scene, pose, stop = LiveScene('road', network), poses(records)[30], threading.Event()

    def publish():
        while not stop.wait(0.08):
            now = time.time_ns()
            scene.add_frame(replace(template, stamp_ns=now))
            scene.add_track(replace(pose, stamp_ns=now))

    thread = threading.Thread(target=publish)
    with PageServer(scene, port=0) as server, browser() as chromium:
        page = Page(chromium, server.url)
        page.wait('magTracking.connected')
        page.value(RECORD_DELAYS)
        thread.start()
        try:
            page.wait('window.delays.length > 80')
        finally:
            stop.set()
            thread.join()
        # The first delays include the drawing of the whole scene.
        return float(np.median(page.value('window.delays')[20:]))


def main():
    """Print the figures; return 1 if an aim is missed or if there were losses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--minutes', type=float, default=1.0)
    args = parser.parse_args()
    figures = Figures('pages')
    figures.add('from the timestamp of a pose to its drawing, median', drawing_delay(), 'ms',
                MAX_DELAY_MS)
    p99, has_losses = {0: [], PAGES: []}, False
    for k in range(args.rounds):
        for n in (0, PAGES) if k % 2 == 0 else (PAGES, 0):
            print(f'--- round {k + 1}, {n} pages', flush=True)
            found = measure(argparse.Namespace(
                sensors=100, minutes=args.minutes, batches=False, one_process=False, lean=False,
                sequential=False, pages=n))
            if found is None:
                return 1
            p99[n].append(found[0])
            has_losses |= found[1]
    without, with_pages = np.median(p99[0]), np.median(p99[PAGES])
    print(f'99 % quantile of the latency: {without:.1f} ms without pages, '
          f'{with_pages:.1f} ms with {PAGES} pages; ratio {with_pages / without:.2f} '
          f'(aim {MAX_WORSE}); {"with" if has_losses else "without"} losses')
    figures.record(f'99 % latency with {PAGES} pages over that without', with_pages / without,
                   'times', MAX_WORSE)
    return int(figures.save() or has_losses)


if __name__ == '__main__':
    sys.exit(main())
