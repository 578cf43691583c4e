"""Selection of the source of a device's only sensor, where the drivers file does not name it."""

from typing import TypeAlias

from mag_tracking.units import NS

RELEASED_S = 5.0
"""[s] A source that is silent for longer gives its place to another."""

Source: TypeAlias = tuple[str, str]
"""(the device's name of the sensor, address)."""


class SingleSource:
    """The source that is taken for the only sensor: two of them at once would be neither.

    It is the first that is heard, until it is silent: a stray message that came before the device
    does not keep its place.

    Attributes
    ----------
    changes : int
    """

    def __init__(self) -> None:
        self.changes = 0
        self._source: Source | None = None
        self._heard_ns = 0

    def is_this(self, source: Source, now_ns: int) -> bool:
        """Whether `source`, heard at `now_ns` (monotonic), is the sole source."""
        if self._source is not None and self._source != source \
                and now_ns - self._heard_ns > RELEASED_S * NS:
            self.changes += 1
            self._source = None
        self._source = self._source or source
        if self._source != source:
            return False
        self._heard_ns = now_ns
        return True
