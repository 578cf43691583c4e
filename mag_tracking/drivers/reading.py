"""What the rooms of the drivers share: a device's reading, and the three small protocols.

A *transport* moves bytes (serial line, UDP, MQTT). A *framing* finds readings in
bytes and is a pure function. A *device* gives readings with the time when they
came: a transport with a framing, a chip on a bus, or the simulator.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeAlias

Axes: TypeAlias = tuple[float, float, float]
"""x, y and z."""


class Reading(NamedTuple):
    """What one device said once of one sensor, in the device's own units."""

    sensor: str = ''
    """The device's name of the sensor; empty where it names none."""
    field: Axes | None = None
    """In the device's unit, sensor frame; NaN = an axis that it does not report, or that was over
    its range; None = it says nothing of the field."""
    acceleration: Axes | None = None
    """In the device's unit, sensor frame; None = none."""
    ticks: float | None = None
    """The device's clock when it measured; None = it has none."""
    sequence: int | None = None
    """Its count of readings; None = it does not count."""


@dataclass(frozen=True, slots=True)
class Parsed:
    """What a framing found in some bytes."""

    readings: tuple[Reading, ...] = ()
    consumed: int = 0
    """Bytes from the beginning that need not be seen again."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    """{cause: how many}, the cause in the plural: 'frames with a wrong checksum',
    'bytes between frames'."""


class Framing(Protocol):
    """Finds readings in bytes; holds settings, and nothing of what it has seen."""

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """All readings in `data`.

        What may be the beginning of a frame stays unconsumed, never more than the
        longest frame; with `final` nothing follows (a datagram), all is consumed, and
        what is no frame is counted. The same bytes in other pieces, each time with
        the rest of the time before in front, give the same readings and counts.
        """


class Chunk(NamedTuple):
    """Bytes that came together."""

    arrival_ns: int
    """`time.monotonic_ns()` when they came."""
    data: bytes
    source: str = ''
    """Where they came from, if the transport can tell: an MQTT topic, a UDP address."""


class Transport(Protocol):
    """Moves bytes. None of its methods is called before `open` or from two threads, but `close`."""

    whole: bool
    """Each chunk is a message of its own (a datagram), and no frame reaches into the next."""
    counts: Counter[str]
    """What was lost on the way, by cause ('messages dropped, queue full')."""

    def open(self) -> None:
        """Open it; raises DeviceError that says what to do, and leaves nothing open then."""

    def read(self, timeout_s: float) -> list[Chunk]:
        """What has come, at once if something has; [] after `timeout_s` if nothing has.

        Raises DeviceError where the connection is lost.
        """

    def close(self) -> None:
        """Close it; may be called twice, and before `open`."""


class Arrival(NamedTuple):
    """A reading that came."""

    arrival_ns: int
    """`time.monotonic_ns()` when it came."""
    reading: Reading
    source: str = ''
    """As of its `Chunk`. What comes from one source is stamped by one clock."""


class Device(Protocol):
    """Gives readings; otherwise as `Transport`."""

    @property
    def counts(self) -> Counter[str]:
        """As `Transport.counts`."""

    def open(self) -> None:
        """As `Transport.open`."""

    def read(self, timeout_s: float) -> list[Arrival]:
        """As `Transport.read`."""

    def close(self) -> None:
        """As `Transport.close`."""
