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

def records_of(data: bytes, latest_ns: int, max_messages: int
               ) -> tuple[IntArray, list[tuple[int, int, int]], int]:
    """Locate the records of an MCAP chunk.

    Parameters
    ----------
    data : bytes
        Uncompressed records of the chunk.
    latest_ns : int, ns
        Upper limit of the log times. Later times, which MCAP permits, are clipped.
    max_messages : int
        Largest accepted number of messages.

    Returns
    -------
    messages : (n, 4) int array
        Channel, log time [ns], and begin and end of the message bytes in `data`.
    definitions : list of (int, int, int)
        Opcode, begin and end of each schema and channel record.
    end : int
        Index in `data` after the last complete record.

    Raises
    ------
    EOFError
        If a message is shorter than its header.
    ValueError
        If there are more messages than `max_messages`.
    """
