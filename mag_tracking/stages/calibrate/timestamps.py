"""Timestamps that jump ahead: rejected until the next one confirms the jump."""


class JumpAheadCheck:
    """Rejects a timestamp far ahead of the last, unless the one before it was there already."""

    def __init__(self, longest_ns: float) -> None:
        """`longest_ns` [ns]: a longer jump has to be confirmed."""
        self._longest_ns = longest_ns
        self._unconfirmed: dict[str, int] = {}

    def __contains__(self, sensor: str) -> bool:
        return sensor in self._unconfirmed

    def shift(self, sensor: str, by_ns: int) -> None:
        """The timestamps of `sensor` are later from now on."""
        if sensor in self._unconfirmed:
            self._unconfirmed[sensor] += by_ns

    def is_ahead(self, sensor: str, stamp_ns: int, last_ns: int) -> bool:
        """Whether a timestamp is far ahead of the last accepted one, and not confirmed."""
        if stamp_ns - last_ns <= self._longest_ns:
            self._unconfirmed.pop(sensor, None)
            return False
        before = self._unconfirmed.get(sensor)
        self._unconfirmed[sensor] = stamp_ns
        return before is None or not 0 < stamp_ns - before <= self._longest_ns
