"""Selection of the source of a device's only sensor, if the drivers file names no source."""

from typing import TypeAlias

from mag_tracking.units import NS

RELEASE_TIMEOUT_S = 5.0
"""[s] Silence of the selected source after which another source may be selected."""

Source: TypeAlias = tuple[str, str]
"""(name of the sensor at the device, source of the arrival)."""


class SingleSource:
    """Selects the source of a device's only sensor.

    A source remains selected until it has been silent for `RELEASE_TIMEOUT_S`. A stray message
    before the start of the device therefore does not block the device permanently.

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
        """Update the selection; return whether `source` is selected.

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
