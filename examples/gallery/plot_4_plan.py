"""
Plan a network
==============

How accurately can a network locate a vehicle, where can it detect one, and where would one more
sensor help most? Cramér-Rao bounds answer these questions before any sensor is installed.
"""

# %%
from pathlib import Path

import mag_tracking as mt
from mag_tracking.apps.plan_report import detection_figure, position_figure, sensor_figure

NETWORK = Path(mt.__file__).parents[1] / 'config' / 'network.yaml'

plan = mt.plan(NETWORK, 'car', heading=[0.0, 180.0], offset=[-2.0, -2.0], grid=31)
for lane in plan.lanes:
    print(f'{lane.name}: bound at the closest point '
          f'{lane.pass_std[:, 0].min():.3f} m')

# %%
# Position bound of a passing car, given the measurements of the whole pass. No unbiased estimator
# is more accurate. Real vehicles are not point dipoles; their errors are several times larger.
figure = position_figure(plan)

# %%
# Probability of detecting a car, as a function of its position.
figure = detection_figure(plan)

# %%
# Improvement by one more sensor, as a function of the position of this sensor.
figure = sensor_figure(plan)
