"""
Published figures: detection and bounds (MITRE12)
=================================================

Detection probability of one and five sensors and Cramér-Rao bounds, after Slater and Jacyna. The
script ``examples/mitre12.py`` prints which published numbers are reproduced and which are not.
"""

# %%
import mitre12

figure = mitre12.figure_2()

# %%
figure = mitre12.figure_4()

# %%
figure = mitre12.figure_5()

# %%
print(mitre12.detection_report(mitre12.compare_detection()))
