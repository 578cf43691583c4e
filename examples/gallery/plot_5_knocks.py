"""
Calibrate a network by knocks
=============================

Eight sensors stand along a road. Their installer knocked twice on the ground: the accelerometers
of all sensors record the same shock, which reveals the offsets of their clocks. Gravity gives the
tilt of each sensor, the Earth's field its heading.
"""

# %%
from pathlib import Path

import numpy as np

import mag_tracking as mt
from mag_tracking.apps.calibrate import calibrate
from mag_tracking.apps.calibrate_report import calibration_figure
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording

DATA = Path(mt.__file__).parents[1] / 'test' / 'data' / 'corridor'
network = mt.read_network(DATA / 'network.yaml')

found = calibrate(Recording(DATA / 'corridor_8_sensors.mcap'), network, settings_for('vehicle'),
                  date='2026-05-01')
for name, offset, std in zip(found.network.names, found.network.clock_offset,
                             found.network.orientation_std, strict=True):
    print(f'{name}: clock {1e3 * offset:+6.2f} ms, heading ± {np.rad2deg(std[2]):.1f}°')

# %%
# Left: one knock, timestamped by the clocks of the sensors, before and after calibration. Right:
# rotation of each sensor about the vertical, with its estimated uncertainty.
figure = calibration_figure(found, network)
