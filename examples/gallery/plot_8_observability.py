"""
Published figures: observability (T10)
======================================

Observability of a target that passes one or two magnetometers at constant velocity, after Wahlström
(2010), chapter 5. The script ``examples/t10_observability.py`` prints the comparison with the
published numbers.
"""

# %%
import t10_observability as t10

maps = t10.condition_maps()
figure = t10.figure_5_2()

# %%
figure = t10.figure_5_3(maps['plain'])

# %%
figure = t10.figure_5_4()

# %%
print(t10.report(t10.comparison(maps)))
