"""
Published figures: number of dipoles (TSP14)
============================================

Normalised cost of the fit against the number of dipoles for the bundled passes, as in Figure 7 of
Wahlström and Gustafsson (2014).
"""

# %%
import tsp14_model_order as tsp14

from mag_tracking.apps.fit_report import order_figure

rate = next(iter(tsp14.RATES))
found = tsp14.fit_passes(rate)
figure = order_figure(found)
title = figure.suptitle(f'Simulated passes at {rate} (filled: chosen order)', fontsize=11)
