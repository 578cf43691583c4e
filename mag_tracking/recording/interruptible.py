"""Reading that reports its progress and can be stopped."""


class ReadingStopped(Exception):
    """The caller asked for the reading to end here."""


def until_stopped(read, progress=None, stopped=None):
    """Iterate over the items of `read` until the caller stops it.

    Parameters
    ----------
    read : function
        Takes a function that it calls with the bytes done since the last call; returns an
        iterator.
    progress : function, optional
        Called with the bytes done since the last call.
    stopped : function, optional
        Asked before every item, and whenever the reading has advanced.

    Raises
    ------
    ReadingStopped
        When `stopped` returns true.
    """
    def advance(n):
        if progress is not None:
            progress(n)
        check()

    def check():
        if stopped is not None and stopped():
            raise ReadingStopped

    for item in read(advance):
        check()
        yield item
