"""Draw the pictures in docs/images from the bundled recordings.

    PYTHONPATH=test .venv/bin/python tools/take_pictures.py
"""

import sys
import tempfile
from pathlib import Path

import mag_tracking as mt
from mag_tracking.apps.calibrate import calibrate
from mag_tracking.apps.calibrate_report import calibration_figure
from mag_tracking.apps.fit_report import pass_figure
from mag_tracking.apps.plan_report import position_figure, sensor_figure
from mag_tracking.cli import main as command
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from support.browser import Page, browser
from support.bundled import DATA, NETWORK_FILE, vehicle_path

IMAGES = Path(__file__).resolve().parents[1] / 'docs' / 'images'
RECORDING = vehicle_path('junction_left_turns_to_rear')
SIZE = {'width': 1280, 'height': 1130}
SHOWN_S = 2.4
"""Slider time [s] at which the car begins to turn."""


def figures():
    """Draw all figures from the recordings: {name: matplotlib Figure}."""
    track = mt.track(RECORDING, NETWORK_FILE)
    truck = mt.fit(vehicle_path('straight_truck_right'), NETWORK_FILE).passes[0].chosen
    plan = mt.plan(NETWORK_FILE, 'car', heading=[0.0, 180.0], offset=[-2.0, -2.0])
    corridor = mt.read_network(DATA / 'corridor' / 'network.yaml')
    recording = DATA / 'corridor' / 'corridor_8_sensors.mcap'
    found = calibrate(Recording(recording), corridor, settings_for('vehicle'), date='2026-05-01')
    return {'pass': mt.track(recording, corridor).pass_figure(max_std=1.0),
            'junction_map': track.map_figure(), 'junction_weights': track.weights_figure(),
            'junction_field': track.field_figure(), 'truck_fit': pass_figure(truck, 'truck'),
            'plan_position': position_figure(plan), 'plan_sensor': sensor_figure(plan),
            'calibration': calibration_figure(found, corridor)}


def main():
    """Draw the figures, replay the recording and render its report; return the exit status."""
    for name, figure in figures().items():
        figure.savefig(IMAGES / f'{name}.png', dpi=110)
    with tempfile.TemporaryDirectory() as folder, browser() as chromium:
        status = command(['replay', str(RECORDING), '--network', str(NETWORK_FILE), '--out', folder,
                          '--no-figures'])
        page = Page(chromium, (Path(folder) / 'report.html').as_uri(), viewport=SIZE)
        page.wait('magTracking.drawn > 0')
        page.move_slider(SHOWN_S)
        page.page.wait_for_timeout(500)
        page.page.screenshot(path=IMAGES / 'report.png')
        phone_page = Page(chromium, (Path(folder) / 'report.html').as_uri(),
                          viewport={'width': 390, 'height': 844}, device_scale_factor=2)
        phone_page.wait('magTracking.drawn > 0')
        phone_page.move_slider(0.5)
        phone_page.page.wait_for_timeout(500)
        phone_page.page.screenshot(path=IMAGES / 'report_telephone.png')
    return status


if __name__ == '__main__':
    sys.exit(main())
