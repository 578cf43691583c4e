"""Style of figures and pages: colours, readable units, literal text, legends and image files."""

import io
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from mag_tracking.files import new_binary_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, VERMILLION, GREEN, ORANGE, PINK, SKY = (
    '#0072B2', '#D55E00', '#009E73', '#E69F00', '#CC79A7', '#56B4E9')
"""Palette of Okabe and Ito 2008, Color universal design; readable with colour blindness."""
SERIES_COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY)
"""Colours of curves, in order; vermillion is reserved for smoothed tracks."""
AXIS_COLOURS = (VERMILLION, GREEN, BLUE)
MINOR_LABEL_DECADES = 1.5
"""Range of a logarithmic axis [decades] up to which values between powers of ten are labelled."""
DOTS_PER_INCH = 110
SCALE_1D = 1.645
"""Half width of a 90 % interval, in standard deviations."""
_ZERO_WIDTH_SPACE = '\u200b'


def series_colour(k: int) -> str:
    """Colour of the curve with the index `k`."""
    return SERIES_COLOURS[k % len(SERIES_COLOURS)]


def scale_of(extent: float) -> tuple[float, str]:
    """Factor from metres to a readable unit for lengths up to `extent` [m], and its symbol."""
    return (1.0, 'm') if extent > 1.0 else (1e3, 'mm')


def field_unit(strongest: float) -> tuple[float, str]:
    """Factor from tesla to a readable unit for fields up to `strongest` [T], and its symbol."""
    return (1e9, 'nT') if strongest < 1e-5 else (1e6, 'µT') if strongest < 1e-2 else (1e3, 'mT')


def literal(text: str) -> str:
    r"""Escape a string so that matplotlib draws it character by character.

    Matplotlib parses text between two `$` as mathematics, and fails on invalid mathematics such as
    `$\road$`. It omits labels that begin with `_` from a legend. Unpaired surrogates, which stand
    for bytes of a file name that are not UTF-8, are escaped as in `\udcff`.
    """
    escaped = text.encode('utf-8', 'backslashreplace').decode().replace('$', r'\$')
    return _ZERO_WIDTH_SPACE + escaped if escaped.startswith('_') else escaped


def legend_beside(axes: 'Axes') -> None:
    """Draw a legend to the right of the axes."""
    axes.legend(fontsize=8, loc='upper left', bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0)


def plain_log_ticks(axes: 'Axes') -> None:
    """Label a logarithmic y axis of up to six decades with plain numbers such as 0.02 and 3."""
    # Imported here because pages, which use the colours and units, do not need matplotlib.
    from matplotlib.ticker import FuncFormatter, NullFormatter

    low, high = axes.get_ylim()
    plain = FuncFormatter(lambda value, _: f'{value:g}')
    if low <= 0.0 or high / low > 1e6:
        return
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(
        plain if high / low < 10.0**MINOR_LABEL_DECADES else NullFormatter())


def save_figure(figure: 'Figure', path: str | PathLike[str]) -> None:
    """Write a figure in the format of the suffix, in place of any file or link; raises OSError."""
    image = io.BytesIO()
    figure.savefig(image, format=Path(path).suffix.removeprefix('.').lower(), dpi=DOTS_PER_INCH)
    with new_binary_file(path) as stream:
        stream.write(image.getbuffer())
