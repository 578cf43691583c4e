"""
Fit of a truck
==============

On a straight road, a batch fit of the whole pass is the most accurate estimate. A vehicle is
modelled as a line of one to four dipoles at constant velocity. An information criterion selects the
number of dipoles.
"""

# %%
from pathlib import Path

import mag_tracking as mt
from mag_tracking.apps.fit_report import order_figure, pass_figure

DATA = Path(mt.__file__).parents[1] / 'test' / 'data'
NETWORK = Path(mt.__file__).parents[1] / 'config' / 'network.yaml'

found = mt.fit(DATA / 'vehicles' / 'straight_truck_right.mcap', NETWORK)
truck = found.passes[0]
chosen = truck.chosen
print(f'{chosen.n_dipoles} dipoles, normalised cost {chosen.normalised_cost:.1f}')
print(f'speed {chosen.speed[0]:.2f} ± {chosen.speed[1]:.2f} m/s, '
      f'length {chosen.length[0]:.1f} ± {chosen.length[1]:.1f} m')

# %%
# Measured (dots) and fitted field (lines). 90 % of the measurements should lie within the bands,
# which include the model error.
figure = pass_figure(chosen, 'truck')

# %%
# The cost decreases with each dipole. A single dipole does not describe a truck.
figure = order_figure(found.passes)

# %%
# The table has one row per pass and number of dipoles.
found.to_dataframe()[['n_dipoles', 'chosen', 'normalised_cost', 'speed', 'sd_speed', 'reason']]
