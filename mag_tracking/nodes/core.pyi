"""Compiled deadline that ends the process even while Python is blocked."""

class Deadline:
    """Ends the process with `status` after `seconds`, unless `cancel` is called before.

    The deadline runs in a native thread, so code that holds the interpreter lock does not delay it.
    No buffer is flushed and no `finally` block runs. Up to 4096 bytes of `message` are written to
    standard error, unless that would block. Raises ValueError unless `seconds` is from 0 to 1e6.
    """

    def __init__(self, seconds: float, status: int, message: bytes) -> None: ...
    def cancel(self) -> None:
        """Cancel the deadline; may be called repeatedly."""

def end_within(seconds: float, status: int, message: bytes) -> None:
    """Start a `Deadline` that cannot be cancelled, and that covers the end of the interpreter."""
