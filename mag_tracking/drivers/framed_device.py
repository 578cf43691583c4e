"""A device that is a transport with a framing."""

from collections import Counter

from mag_tracking.drivers.reading import Arrival, Framing, Transport


class FramedDevice:
    """Readings that `framing` finds in what `transport` brings; see `reading.Device`."""

    def __init__(self, transport: Transport, framing: Framing) -> None:
        self._transport, self._framing = transport, framing
        self._rest = b''
        self._found: Counter[str] = Counter()
        # What is known of the devices that speak so, without being told.
        self.CLOCK, self.DRIVER = (getattr(framing, name, {}) for name in ('CLOCK', 'DRIVER'))

    @property
    def counts(self) -> Counter[str]:
        """What was lost on the way or was no frame, by cause."""
        # Copied as wholes: the other thread may count something new in the meantime.
        total = self._found.copy()
        total.update(self._transport.counts.copy())
        return total

    def open(self) -> None:
        """Open the transport; what was left of the last connection is no beginning of a frame."""
        if self._rest:
            self._found['bytes of a frame that was cut off'] += len(self._rest)
            self._rest = b''
        self._transport.open()

    def read(self, timeout_s: float) -> list[Arrival]:
        """The readings that came, as `Arrival`s; [] after `timeout_s`. Raises DeviceError."""
        out: list[Arrival] = []
        for chunk in self._transport.read(timeout_s):
            data = chunk.data if self._transport.whole else self._rest + chunk.data
            parsed = self._framing.parse(data, final=self._transport.whole)
            if not self._transport.whole:
                self._rest = data[parsed.consumed:]
            self._found.update(parsed.rejected)
            out += [Arrival(chunk.arrival_ns, reading, chunk.source)
                    for reading in parsed.readings]
        return out

    def close(self) -> None:
        """Close the transport."""
        self._transport.close()
