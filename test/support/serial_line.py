"""A serial line for the tests: a pseudo-terminal under a path, which can vanish and come back."""

import os
import tty


class SerialLine:
    """The device's end of a line whose other end is `path`."""

    def __init__(self, path):
        self.path = path
        self._master = None

    def plug_in(self):
        """The port appears."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        os.symlink(os.ttyname(slave), self.path)
        os.close(slave)

    def send(self, data):
        """The device says something; what nobody reads is lost."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass

    def pull_out(self):
        """The port vanishes."""
        os.unlink(self.path)
        os.close(self._master)
        self._master = None
