"""Render docs/images/report.png and report_telephone.png: the report of a recording in Chromium.

    PYTHONPATH=test .venv/bin/python tools/take_pictures.py
"""

import sys
import tempfile
from pathlib import Path

from mag_tracking.cli import main as command
from support.browser import Page, browser
from support.bundled import NETWORK_FILE, vehicle_path

IMAGES = Path(__file__).resolve().parents[1] / 'docs' / 'images'
RECORDING = vehicle_path('junction_left_turns_to_rear')
SIZE = {'width': 1280, 'height': 1130}
SHOWN_S = 2.4
"""Time of the slider [s]: the car begins to turn."""


def main():
    """Replay the recording and render its report; return the exit status."""
    with tempfile.TemporaryDirectory() as folder, browser() as chromium:
        status = command(['replay', str(RECORDING), '--network', str(NETWORK_FILE), '--out', folder,
                          '--no-figures'])
        page = Page(chromium, (Path(folder) / 'report.html').as_uri(), viewport=SIZE)
        page.wait('magTracking.drawn > 0')
        page.move_slider(SHOWN_S)
        page.page.wait_for_timeout(500)
        page.page.screenshot(path=IMAGES / 'report.png')
        telephone = Page(chromium, (Path(folder) / 'report.html').as_uri(),
                         viewport={'width': 390, 'height': 844}, device_scale_factor=2)
        telephone.wait('magTracking.drawn > 0')
        telephone.move_slider(0.5)
        telephone.page.wait_for_timeout(500)
        telephone.page.screenshot(path=IMAGES / 'report_telephone.png')
    return status


if __name__ == '__main__':
    sys.exit(main())
