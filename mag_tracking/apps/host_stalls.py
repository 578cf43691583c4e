"""Stalls of the computer that receives the readings of several sensors."""

from collections.abc import Collection, Iterator

from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.units import NS

STALL_S = 0.25
"""[s] Minimum interval without a message from any sensor that counts as a stall."""
BURST_S = 0.05
"""[s] Time after a stall in which the delayed messages arrive."""
MIN_BURST = 3.0
"""Minimum number of messages in this time, relative to the mean."""
MIN_STALLS = 2
"""Number of stalls at which a computer is considered overloaded."""
MAX_FRACTION = 0.5
"""Fraction of the messages that arrive after stalls above which devices send them in packets."""
TIME_CAUSES = frozenset({Cause.LOST, Cause.DELAY_VARIES, Cause.DELAYED, Cause.CLOCK_STEPPED})
"""Causes that an overloaded computer explains."""


class HostStalls:
    """Detects that messages of all sensors stop together and then arrive in a burst.

    Sensors do not stall together, but an overloaded computer, or the link that they share, delays
    all messages alike.
    """

    def __init__(self) -> None:
        self._sensors: set[str] = set()
        self._first_ns: int | None = None
        self._last_ns, self._n = 0, 0
        # Time of the latest stall, messages since then, and whether it has been counted.
        self._stall_ns, self._n_burst, self._gap_s = 0, 0, 0.0
        self.n_stalls, self.longest_s, self._n_delayed = 0, 0.0, 0

    def add(self, received_ns: int, sensors: Collection[str]) -> None:
        """Add a message received at `received_ns` with readings of `sensors`."""
        self._sensors.update(sensors)
        if self._first_ns is None:
            self._first_ns = self._last_ns = received_ns
        gap_s, elapsed_s = (received_ns - self._last_ns) / NS, (received_ns - self._first_ns) / NS
        self._last_ns, self._n = received_ns, self._n + 1
        if gap_s > STALL_S:
            self._stall_ns, self._n_burst, self._gap_s = received_ns, 0, gap_s
        if not self._gap_s:
            return
        self._n_burst += 1
        if received_ns - self._stall_ns > BURST_S * NS:
            self._gap_s = 0.0
        elif self._n_burst >= MIN_BURST * (1.0 + BURST_S * self._n / max(elapsed_s, STALL_S)):
            self.n_stalls += 1
            self.longest_s = max(self.longest_s, self._gap_s)
            self._n_delayed += round(self._gap_s * self._n / max(elapsed_s, STALL_S))
            self._gap_s = 0.0

    def findings(self) -> Iterator[Finding]:
        """Report an overloaded computer."""
        if len(self._sensors) > 1 and self.n_stalls >= MIN_STALLS \
                and self._n_delayed < MAX_FRACTION * self._n:
            yield Finding(False, 'computer', f'the messages of all sensors stopped {self.n_stalls} '
                          f'times, for up to {self.longest_s:.2g} s, and then arrived together',
                          'the computer is overloaded, or the link that the sensors share stalls: '
                          'reduce the load of the computer that receives the messages',
                          Cause.OVERLOADED)


def load_findings(found: Collection[Finding], sensors: Collection[str], load: float,
                  n_processors: int) -> Iterator[Finding]:
    """Report a high load of the computer if readings of all sensors are late or lost.

    `load` is the mean number of processes that run or wait for a processor.
    """
    late = {f.subject for f in found if f.cause in TIME_CAUSES}
    if load > n_processors and sensors and late.issuperset(sensors):
        yield Finding(False, 'computer', f'{load:.1f} processes compete for '
                      f'{n_processors} processors: the computer is overloaded', 'reduce the load '
                      'of this computer', Cause.OVERLOADED)
