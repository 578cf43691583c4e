"""What has to happen even while Python is held up, compiled."""

class Deadline:
    """Ends the process unless it is cancelled in time.

    A thread that needs nothing of Python waits for it: code that keeps the interpreter's lock
    cannot hold it up. No buffer is flushed and no `finally` runs.
    """

    def __init__(self, seconds: float, status: int, message: str) -> None:
        """
        Parameters
        ----------
        seconds : float
            From now on.
        status : int
            Exit status of the process.
        message : str
            Written to the standard error.
        """

    def cancel(self) -> None:
        """Let the process live on."""
