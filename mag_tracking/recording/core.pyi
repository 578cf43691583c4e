"""What is read and written many thousand times, compiled."""

from mag_tracking.arrays import FloatArray, IntArray

def number_rows(values: FloatArray) -> list[str]:
    """Each row of `values` (n, m) as m numbers with commas, which read back as the same."""

def records_of(data: bytes, latest_ns: int) -> tuple[IntArray, list[tuple[int, int, int]]]:
    """The messages, and the schemas and channels.

    Parameters
    ----------
    data : bytes
        The records of a chunk, as they are in the file.
    latest_ns : int
        Later log times, which MCAP may have, count as this.

    Returns
    -------
    messages : (n, 4) int array
        Channel, log time [ns], and where the bytes of each begin and end.
    definitions : list of (int, int, int)
        The kind of each record, and where it begins and ends.

    Raises EOFError where the chunk is damaged.
    """
