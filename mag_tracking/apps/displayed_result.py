"""Display of results in a notebook, and progress of a run in a notebook or terminal."""

import html
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tqdm.auto import tqdm

from mag_tracking.errors import MissingDependencyError
from mag_tracking.recording.message_block import Progress
from mag_tracking.run import RecordingSource, Source

if TYPE_CHECKING:
    import pandas as pd

MAX_ROWS = 20
"""Maximum number of rows of a table in a notebook."""


class DisplayedResult:
    """Result that a notebook shows as its summary and the first rows of its table."""

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the result to a table.

        Returns
        -------
        pandas.DataFrame
        """
        raise NotImplementedError

    def _repr_html_(self) -> str:
        summary = f'<p>{html.escape(repr(self))}</p>'
        try:
            return summary + self.to_dataframe().to_html(max_rows=MAX_ROWS)
        except MissingDependencyError:
            return summary


@contextmanager
def shown_progress(source: Source) -> Iterator[Progress]:
    """Show a progress bar for a recording in a terminal or notebook; yield its function."""
    if not isinstance(source, RecordingSource):
        yield lambda n: None
        return
    with tqdm(total=source.recording.size, unit='B', unit_scale=True, desc=source.name,
              disable=None, leave=False) as bar:
        yield bar.update
