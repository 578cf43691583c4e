"""Search for sensors whose field is weaker than the Earth's field."""

import numpy as np

from mag_tracking.records import Readings
from mag_tracking.units import NS

WEAK_FIELD = 10e-6
"""[T] Largest field of a weak sensor. The Earth's field is 22 to 67 uT; a smaller field suggests a
wrong unit, such as gauss instead of microtesla."""
WEAK_S = 5.0
"""[s] Time for which the field of a weak sensor stays below `WEAK_FIELD`."""


class FieldStrength:
    """Finds sensors whose field stays below `WEAK_FIELD`, and judges each once."""

    def __init__(self) -> None:
        self._judged: set[str] = set()
        self._since_ns: dict[str, int] = {}

    def add(self, readings: Readings) -> list[str]:
        """Add readings; return the sensors that are judged as weak by this call.

        Readings with a missing axis are not judged.
        """
        if self._judged.issuperset(readings.names):
            return []
        weak = []
        strength = np.linalg.norm(readings.field, axis=1)
        for j in np.unique(readings.sensor[~np.isnan(strength)]).tolist():
            name, own = readings.names[j], readings.sensor == j
            if name in self._judged:
                continue
            since_ns = self._since_ns.setdefault(name, int(readings.stamp_ns[own].min()))
            is_weak = bool(np.nanmax(strength[own]) < WEAK_FIELD)
            if is_weak and readings.stamp_ns[own].max() - since_ns >= WEAK_S * NS:
                weak.append(name)
            if not is_weak or name in weak:
                self._judged.add(name)
        return weak
