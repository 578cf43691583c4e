"""Compiled functions that locate the records of MCAP chunks and format numbers."""

from mag_tracking.arrays import FloatArray, IntArray

def number_rows(values: FloatArray) -> list[str]:
    """Format the rows of a matrix as comma-separated numbers.

    Parameters
    ----------
    values : (n, m) array

    Returns
    -------
    list of str, length n
        Shortest decimal representations that are parsed to the same numbers.
    """

def records_of(data: bytes, latest_ns: int) -> tuple[IntArray, list[tuple[int, int, int]]]:
    """Locate the records of an MCAP chunk.

    Parameters
    ----------
    data : bytes
        Uncompressed records of the chunk.
    latest_ns : int, ns
        Upper limit of the log times. Later times, which MCAP permits, are clipped.

    Returns
    -------
    messages : (n, 4) int array
        Channel, log time [ns], and begin and end of the message bytes in `data`.
    definitions : list of (int, int, int)
        Opcode, begin and end of each schema and channel record.

    Raises
    ------
    EOFError
        If the chunk is damaged.
    """
