"""
A car turns at a junction
=========================

Two magnetometers stand opposite each other beside a road. A car arrives from the left and turns
into the side street between them. ``make demo`` replays this recording over ROS topics.
"""

# %%
# ``mt.track`` runs the same stages as the ROS nodes, without ROS.
from pathlib import Path

import mag_tracking as mt

DATA = Path(mt.__file__).parents[1] / 'test' / 'data'
NETWORK = Path(mt.__file__).parents[1] / 'config' / 'network.yaml'

result = mt.track(DATA / 'vehicles' / 'junction_left_turns_to_rear.mcap', NETWORK)
print(result)

# %%
# The pass: the vehicle to scale at five published poses, their 90 % regions, and the smoothed path.
figure = result.pass_figure()

# %%
# Map of the hypotheses: the published poses with 90 % ellipses (circles mark ambiguous poses), the
# smoothed track, the ground truth, and the best hypothesis of each arrival direction.
figure = result.map_figure()

# %%
# At first, several arrival directions explain the field. Their weights show how the evidence
# accumulates until only one direction remains.
figure = result.weights_figure()

# %%
# The measured field (dots) and the field that the track predicts (lines), per sensor and axis.
figure = result.field_figure()

# %%
# The recording contains the true poses. ``closest`` is the error at the closest point of approach.
# ``anees`` is the average normalised estimation error squared per axis, which is near one if the
# covariance is consistent.
result.errors()

# %%
# Poses are structured arrays and, with pandas, a DataFrame with units in ``attrs``.
poses = result.poses_dataframe()
poses[['stamp_ns', 'x', 'y', 'sd_x', 'sd_y', 'weight', 'ambiguous', 'doubts']].iloc[::6]
