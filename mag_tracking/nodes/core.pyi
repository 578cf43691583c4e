"""Compiled deadline that ends the process even while Python is blocked."""

class Deadline:
    """Ends the process when the time has elapsed, unless `cancel` is called before.

    The deadline runs in a native thread, so code that holds the interpreter lock does not delay it.
    When the process is ended, no buffer is flushed and no `finally` block runs.

    Parameters
    ----------
    seconds : float, s
        Time from now.
    status : int
        Exit status of the process.
    message : bytes
        Written to standard error, up to 4096 bytes, unless that would block.

    Raises
    ------
    ValueError
        If `seconds` is not between 0 and 1e6.
    """

    def __init__(self, seconds: float, status: int, message: bytes) -> None: ...
    def cancel(self) -> None:
        """Cancel the deadline; may be called repeatedly."""

def end_within(seconds: float, status: int, message: bytes) -> None:
    """Start a `Deadline` that cannot be cancelled; it also covers the shutdown of the interpreter.

    Parameters
    ----------
    seconds : float, s
        Time from now.
    status : int
        Exit status of the process.
    message : bytes
        Written to standard error, up to 4096 bytes, unless that would block.

    Raises
    ------
    ValueError
        If `seconds` is not between 0 and 1e6.
    """
