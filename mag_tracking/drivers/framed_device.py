"""Device composed of a transport and a framing."""

from collections import Counter

from mag_tracking.drivers.reading import Arrival, Framing, Transport


class FramedDevice:
    """Device that applies a framing to the data of a transport, a `reading.Device`.

    Attributes
    ----------
    CLOCK, DRIVER : settings common to all devices with this framing
    examples : first rejected line and the remedy, by cause; the dict is replaced, never changed
    """

    def __init__(self, transport: Transport, framing: Framing) -> None:
        self._transport, self._framing = transport, framing
        self._unconsumed = b''
        self._rejected: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        self.CLOCK, self.DRIVER = (getattr(framing, name, {}) for name in ('CLOCK', 'DRIVER'))

    @property
    def counts(self) -> Counter[str]:
        """Numbers of losses and rejections, by cause."""
        # Each counter is copied in one step, because the polling thread may add a cause meanwhile.
        total = self._rejected.copy()
        total.update(self._transport.counts.copy())
        return total

    def open(self) -> None:
        """Open the transport; discard and count unconsumed bytes of the previous connection."""
        if self._unconsumed:
            self._rejected['bytes of truncated frames'] += len(self._unconsumed)
            self._unconsumed = b''
        self._transport.open()

    def read(self, timeout_s: float) -> list[Arrival]:
        """Return the readings received; wait only if no data is available."""
        out: list[Arrival] = []
        for chunk in self._transport.read(timeout_s):
            data = (chunk.data if self._transport.is_message_oriented
                    else self._unconsumed + chunk.data)
            parsed = self._framing.parse(data, final=self._transport.is_message_oriented)
            if not self._transport.is_message_oriented:
                self._unconsumed = data[parsed.consumed:]
            self._rejected.update(parsed.rejected)
            if parsed.examples:
                self.examples = {**parsed.examples, **self.examples}
            out += [Arrival(chunk.arrival_ns, reading, chunk.source)
                    for reading in parsed.readings]
        return out

    def close(self) -> None:
        """Close the transport."""
        self._transport.close()
