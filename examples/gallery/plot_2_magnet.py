"""
A magnet moves past sixteen sensors
===================================

A cylindrical magnet of Ø10×10 mm is moved past sixteen real three-axis sensors. An optical system
measures the true poses. The measurements are stored in tables, not in a recording.
"""

# %%
# Import the tables, and write a recording and a network file.
import tempfile
from pathlib import Path

import numpy as np

import mag_tracking as mt
from mag_tracking.recording.pose_table import import_pose_table

DATA = Path(mt.__file__).parents[1] / 'test' / 'data' / 'magnet_16_sensors'
folder = tempfile.TemporaryDirectory()

recording, network, n_readings = import_pose_table(
    DATA / 'lisa_data1.csv', DATA / 'lisa_data1_background.csv', folder.name, noise_std=1e-6)
print(n_readings, 'readings of', len(mt.read_network(network)), 'sensors')

# %%
# ``target='magnet'`` estimates five degrees of freedom: the position and the direction of the
# moment. The rotation about the moment is not observable; it is flagged and has the variance π².
result = mt.track(recording, network, target='magnet')
errors = result.errors()
print(f'position: {1e3 * errors["position_mean"]:.2f} mm on average')
print(f'axis:     {errors["axis_median_deg"]:.2f} degrees (median)')

# %%
figure = result.map_figure()

# %%
# Standard deviations of the estimated position, in millimetres.
std = np.sqrt(np.diagonal(result.poses['covariance'], axis1=1, axis2=2)[:, :3])
print('standard deviation, median of x, y, z [mm]:', np.median(1e3 * std, axis=0).round(2))
folder.cleanup()
