"""Data types of device readings, and the protocols `Transport`, `Framing` and `Device`.

A *transport* receives bytes (serial line, UDP, MQTT). A *framing* extracts readings from bytes and
has no state. A *device* returns readings with their times of arrival: a transport with a
framing, the chips on a bus, or the simulator.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeAlias, TypeVar

Axes: TypeAlias = tuple[float, float, float]


class DeviceDate(float):
    """Date and time of a device, in microseconds since 1970 UTC, whatever the clock settings."""


class Reading(NamedTuple):
    """One measurement of one sensor, in the device's own units."""

    sensor: str = ''
    """Name of the sensor at the device; empty if the device does not send it."""
    field: Axes | None = None
    """Field in the device's unit, sensor frame. NaN for an axis that is not reported or exceeds its
    range; None if no field is reported."""
    acceleration: Axes | None = None
    """Acceleration in the device's unit, sensor frame; None if not reported."""
    ticks: float | None = None
    """Device clock at the time of measurement, a `DeviceDate` if it is a date and time; None if the
    device does not send it."""
    sequence: int | None = None
    """Sequence number; None if the device does not number its readings."""


@dataclass(frozen=True, slots=True)
class Parsed:
    """Readings and rejections that a framing has extracted from bytes."""

    readings: tuple[Reading, ...] = ()
    consumed: int = 0
    """Number of leading bytes that are completely parsed and need not be passed again."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    """Number of rejections by cause. A cause is a plural noun phrase, such as 'frames with a wrong
    checksum' or 'bytes between frames'."""
    examples: Mapping[str, str] = field(default_factory=dict)
    """The first rejected line and the remedy, by cause, where a line explains the cause."""


class Framing(Protocol):
    """Extracts readings from bytes. A framing has settings but no state."""

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """Find all readings in `data`.

        An incomplete frame at the end remains unconsumed; the unconsumed part is never longer than
        the longest frame. If `final` is set, as for a datagram, all bytes are consumed, and bytes
        outside frames are counted. The readings and counts of a stream do not depend on its
        division into chunks if each chunk is preceded by the unconsumed bytes of the previous call.

        Parameters
        ----------
        data : bytes
        final : bool, optional
            Whether no bytes follow.

        Returns
        -------
        Parsed
        """


class Chunk(NamedTuple):
    """Bytes that arrived together."""

    arrival_ns: int
    """`time.monotonic_ns()` at arrival."""
    data: bytes
    source: str = ''
    """Origin of the bytes, such as an MQTT topic or a UDP address; empty if unknown."""


class Arrival(NamedTuple):
    """Reading with its time of arrival."""

    arrival_ns: int
    """`time.monotonic_ns()` at arrival."""
    reading: Reading
    source: str = ''
    """Source of the chunk that contains the reading. All readings of one source share a clock."""


Item = TypeVar('Item')


class Connection(Protocol[Item]):
    """Receives chunks or readings.

    Only `close` may be called before `open`, or while another thread calls a method.
    """

    @property
    def counts(self) -> Counter[str]:
        """Number of losses by cause, such as 'empty datagrams'."""

    def open(self) -> None:
        """Open the connection.

        Raises
        ------
        DeviceError
            If opening fails. The message includes the remedy, and nothing remains open.
        """

    def read(self, timeout_s: float) -> list[Item]:
        """Return what was received; wait only if nothing is available.

        Parameters
        ----------
        timeout_s : float, s
            Maximum time to wait.

        Returns
        -------
        list of Chunk or Arrival
            Empty if nothing arrived in time.

        Raises
        ------
        DeviceError
            If the connection is lost.
        """

    def close(self) -> None:
        """Close the connection. May be called twice, and before `open`."""


class Transport(Connection[Chunk], Protocol):
    """Receives bytes over a connection."""

    is_message_oriented: bool
    """Whether each chunk is a complete message (a datagram), so that no frame spans two chunks."""


class Device(Connection[Arrival], Protocol):
    """Receives readings of sensors."""


class FramedDevice:
    """Device that applies a framing to the data of a transport, a `Device`."""

    def __init__(self, transport: Transport, framing: Framing) -> None:
        self._transport, self._framing = transport, framing
        self._unconsumed = b''
        self._rejected: Counter[str] = Counter()
        # The first rejected line and the remedy, by cause; replaced, never changed.
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
        final = self._transport.is_message_oriented
        for chunk in self._transport.read(timeout_s):
            data = chunk.data if final else self._unconsumed + chunk.data
            parsed = self._framing.parse(data, final=final)
            self._unconsumed = b'' if final else data[parsed.consumed:]
            self._rejected.update(parsed.rejected)
            if parsed.examples:
                self.examples = {**parsed.examples, **self.examples}
            out += [Arrival(chunk.arrival_ns, reading, chunk.source)
                    for reading in parsed.readings]
        return out

    def close(self) -> None:
        """Close the transport."""
        self._transport.close()
