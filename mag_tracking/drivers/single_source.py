"""Selection of the source of a device's only sensor, if the drivers file does not name it."""

from typing import TypeAlias

from mag_tracking.units import NS

RELEASE_TIMEOUT_S = 5.0
"""[s] Silence after which another source may be selected."""

Source: TypeAlias = tuple[str, str]
"""(device's name of the sensor, address)."""


class SingleSource:
    """Selects one of several sources as that of the only sensor.

    The first source is selected until it falls silent. A stray message received before the device
    started therefore does not block the device.

    Attributes
    ----------
    changes : int
        Number of times another source was selected.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._source: Source | None = None
        self._last_receipt_ns = 0

    def accepts(self, source: Source, now_ns: int) -> bool:
        """Whether `source` is the selected source.

        Parameters
        ----------
        source : Source
        now_ns : int, ns
            Monotonic time of arrival.

        Returns
        -------
        bool
        """
        if self._source is not None and self._source != source \
                and now_ns - self._last_receipt_ns > RELEASE_TIMEOUT_S * NS:
            self.changes += 1
            self._source = None
        self._source = self._source or source
        if self._source != source:
            return False
        self._last_receipt_ns = now_ns
        return True
