"""A watch over the end of a process, which works while Python is blocked; compiled."""

class Deadline:
    """Ends the process unless it is cancelled in time.

    A native thread waits, so code that keeps the interpreter's lock does not delay it. When the
    process ends, no buffer is flushed and no `finally` runs.
    """

    def __init__(self, seconds: float, status: int, message: bytes) -> None:
        """
        Parameters
        ----------
        seconds : float
            From now on.
        status : int
            Exit status of the process.
        message : bytes
            Written to the standard error, up to 4096 bytes, unless that would block.

        Raises ValueError unless `seconds` is between 0 and 1e6.
        """

    def cancel(self) -> None:
        """Cancel the deadline; may be called again."""

def end_within(seconds: float, status: int, message: bytes) -> None:
    """A `Deadline` that cannot be cancelled; it includes the end of the interpreter."""
