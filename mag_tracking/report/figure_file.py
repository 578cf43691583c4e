"""Figure files."""

import io
from os import PathLike
from pathlib import Path

from matplotlib.figure import Figure

from mag_tracking.files import new_binary_file

_DOTS_PER_INCH = 110


def save_figure(figure: Figure, path: str | PathLike[str]) -> None:
    """Write a figure in the format given by the suffix, replacing any file or link of that name.

    Parameters
    ----------
    figure : Figure
    path : str or path

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, format=Path(path).suffix.removeprefix('.').lower(), dpi=_DOTS_PER_INCH)
    with new_binary_file(path) as stream:
        stream.write(drawn.getbuffer())
