"""Figures over the time of a recording: values of events or vehicles, as points by group."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.report.literal_text import literal
from mag_tracking.report.palette import SERIES_COLOURS
from mag_tracking.report.style import legend_beside


def time_figure(stamp_ns: IntArray, values: FloatArray, std: FloatArray | None,
                groups: Sequence[str], label: str) -> Figure:
    """Draw values (n,), with standard deviations if known, over time, a colour per group."""
    figure = Figure(figsize=(8.0, 3.5), layout='constrained')
    axis = figure.add_subplot()
    times = np.asarray(stamp_ns, dtype='datetime64[ns]')
    for k, group in enumerate(dict.fromkeys(groups)):
        rows = np.array([g == group for g in groups])
        axis.errorbar(times[rows], values[rows], None if std is None else std[rows], fmt='o',
                      color=SERIES_COLOURS[k % len(SERIES_COLOURS)], label=literal(group))
    axis.set_xlabel('time (UTC)')
    axis.set_ylabel(label)
    axis.grid(True, alpha=0.3)
    if len(groups):
        legend_beside(axis)
    else:
        axis.text(0.5, 0.5, 'nothing was found', transform=axis.transAxes, ha='center')
    return figure
