"""Serial line: a pseudo-terminal at a given path, which can be removed and restored."""

import os
import tty


class SerialLine:
    """Device end of a serial line; the host opens the other end, the port `path`."""

    def __init__(self, path):
        self.path = path
        self._master = None

    def plug_in(self):
        """Create the port."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        os.symlink(os.ttyname(slave), self.path)
        os.close(slave)

    def send(self, data):
        """Send bytes from the device; bytes that are not read are lost."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass

    def pull_out(self):
        """Remove the port."""
        os.unlink(self.path)
        os.close(self._master)
        self._master = None
