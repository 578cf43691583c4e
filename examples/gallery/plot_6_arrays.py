"""
Arrays instead of a recording
=============================

A workflow for notebooks: read a recording as arrays, track your own arrays without a bag, and get
the results as DataFrames and figures.
"""

# %%
# A recording as arrays. ``field`` is (n, 3) in tesla, in the frame of each sensor.
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import mag_tracking as mt

DATA = Path(mt.__file__).parents[1] / 'test' / 'data'
NETWORK = Path(mt.__file__).parents[1] / 'config' / 'network.yaml'

network = mt.read_network(NETWORK)
recording = mt.read_recording(DATA / 'vehicles' / 'straight_car_right.mcap', network)
readings = recording.readings
print(readings.field.shape, readings.stamp_ns.dtype, readings.names)

# %%
figure = Figure(figsize=(8.0, 3.0), layout='constrained')
axes = figure.add_subplot(xlabel='time [s]', ylabel='field [µT]', title=readings.names[0])
first = readings.sensor == 0
seconds = 1e-9 * (readings.stamp_ns[first] - readings.stamp_ns[0])
lines = axes.plot(seconds, 1e6 * readings.field[first], lw=0.8, label=['x', 'y', 'z'])
legend = axes.legend(loc='upper left')

# %%
# Arrays of your own: the name of the sensor, the time in nanoseconds and the field of each
# reading, in chronological order. Covariances are optional; if they are missing, the noise is
# estimated. Here, the data of one sensor are missing for a second, as in a radio dropout.
lost = (readings.sensor == 1) & (readings.stamp_ns - readings.stamp_ns[0] > 4_000_000_000) \
    & (readings.stamp_ns - readings.stamp_ns[0] < 5_000_000_000)
own = mt.readings_from_arrays([readings.names[s] for s in readings.sensor[~lost]],
                              readings.stamp_ns[~lost], readings.field[~lost])
result = mt.track(own, network, settings={'detect.false_alarm_probability': 1e-4})
print(result)

# %%
# Results as a DataFrame: the smoothed poses with their standard deviations.
smoothed = result.smoothed_dataframe()
smoothed[['stamp_ns', 'x', 'y', 'sd_x', 'sd_y', 'vx']].iloc[::8]

# %%
# Draw a figure of your own.
figure = Figure(figsize=(8.0, 3.0), layout='constrained')
axes = figure.add_subplot(xlabel='x [m]', ylabel='y [m]',
                          title='smoothed track, ± 2 standard deviations')
filled = axes.fill_between(smoothed.x, smoothed.y - 2.0 * smoothed.sd_y,
                           smoothed.y + 2.0 * smoothed.sd_y, alpha=0.3)
lines = axes.plot(smoothed.x, smoothed.y)
sensors = axes.plot(*network.positions[:, :2].T, 'k^')
assert np.isfinite(smoothed.x).all()
