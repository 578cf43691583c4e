"""Writing of figures to image files."""

import io
from os import PathLike
from pathlib import Path

from matplotlib.figure import Figure

from mag_tracking.files import new_binary_file

_DOTS_PER_INCH = 110


def save_figure(figure: Figure, path: str | PathLike[str]) -> None:
    """Write a figure in the format that the file suffix selects; replaces an existing file or link.

    Raises OSError if the file cannot be written.
    """
    image = io.BytesIO()
    figure.savefig(image, format=Path(path).suffix.removeprefix('.').lower(), dpi=_DOTS_PER_INCH)
    with new_binary_file(path) as stream:
        stream.write(image.getbuffer())
