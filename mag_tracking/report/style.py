"""Common style of the figures: a palette safe for colour-blind people, ticks, legends."""

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

BLUE, VERMILLION, GREEN, ORANGE, PINK, SKY = (
    '#0072B2', '#D55E00', '#009E73', '#E69F00', '#CC79A7', '#56B4E9')
"""Okabe and Ito 2008, Color universal design."""
SERIES = (BLUE, ORANGE, GREEN, PINK, SKY)
"""Colours of curves, in order; vermillion is kept for smoothed tracks."""
AXIS_COLOURS = (VERMILLION, GREEN, BLUE)
"""Colours of the axes x, y, z."""
FEW_DECADES = 1.5
"""Range below which a logarithmic axis has labels between the powers of ten."""


def legend_beside(axes: Axes, **named: float) -> None:
    """A legend to the right of the axes, where it hides nothing."""
    axes.legend(fontsize=8, loc='upper left', bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0,
                **named)


def plain_log_ticks(axes: Axes) -> None:
    """Numbers such as 0.02 and 3 on a logarithmic y axis, in place of powers of ten."""
    low, high = axes.get_ylim()
    plain = FuncFormatter(lambda value, _: f'{value:g}')
    if low <= 0.0 or high / low > 1e6:
        return
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(plain if high / low < 10.0**FEW_DECADES else NullFormatter())
