"""Common style of the figures: ticks and legends."""

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

MINOR_LABEL_DECADES = 1.5
"""Range of a logarithmic axis [decades] up to which values between powers of ten are labelled."""


def legend_beside(axes: Axes, **kwargs: float) -> None:
    """Draw a legend to the right of the axes, with additional arguments of `Axes.legend`."""
    axes.legend(fontsize=8, loc='upper left', bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0,
                **kwargs)


def plain_log_ticks(axes: Axes) -> None:
    """Label a logarithmic y axis with plain numbers such as 0.02 and 3 instead of powers of ten.

    An axis that spans more than six decades is left unchanged.
    """
    low, high = axes.get_ylim()
    plain = FuncFormatter(lambda value, _: f'{value:g}')
    if low <= 0.0 or high / low > 1e6:
        return
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(
        plain if high / low < 10.0**MINOR_LABEL_DECADES else NullFormatter())
