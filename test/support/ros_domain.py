"""ROS domain that no other test run on this machine uses."""

import fcntl
import os
import tempfile
from pathlib import Path

N_DOMAINS = 100
"""Number of domains. Domains 1 to 101 do not use ports that Linux assigns automatically."""


class RosDomain:
    """Reservation of the first free domain; the search starts at a number that depends on the
    process."""

    def __init__(self):
        folder = Path(tempfile.gettempdir()) / f'mag_tracking_domains_{os.getuid()}'
        folder.mkdir(exist_ok=True)
        for k in range(N_DOMAINS):
            self.number = 1 + (os.getpid() + k) % N_DOMAINS
            self._lock = open(folder / str(self.number), 'w')
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                self._lock.close()
        raise RuntimeError(f'all {N_DOMAINS} ROS domains are in use by test runs')

    def __enter__(self):
        return self

    def __exit__(self, *raised):
        self.close()

    def close(self):
        """Release the domain, which is also released at the end of the process."""
        self._lock.close()
