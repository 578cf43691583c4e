"""Reading of a device, and the protocols `Transport`, `Framing` and `Device`.

A *transport* moves bytes (serial line, UDP, MQTT). A *framing* finds readings in bytes and is a
pure function. A *device* returns readings with their time of arrival: a transport with a framing,
a chip on a bus, or the simulator.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeAlias

Axes: TypeAlias = tuple[float, float, float]
"""x, y and z."""


class Reading(NamedTuple):
    """One measurement of one sensor, in the device's own units."""

    sensor: str = ''
    """Name of the sensor at the device; empty if the device names none."""
    field: Axes | None = None
    """Field in the device's unit, sensor frame. NaN = the axis is not reported or over its range;
    None = no field."""
    acceleration: Axes | None = None
    """Acceleration in the device's unit, sensor frame; None = not reported."""
    ticks: float | None = None
    """Device clock at the time of measurement; None = the device has no clock."""
    sequence: int | None = None
    """Sequence number; None = the device sends none."""


@dataclass(frozen=True, slots=True)
class Parsed:
    """Result of a framing."""

    readings: tuple[Reading, ...] = ()
    consumed: int = 0
    """Number of bytes from the beginning that are not needed again."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    """Number of rejections by cause. The cause is a plural: 'frames with a wrong checksum',
    'bytes between frames'."""


class Framing(Protocol):
    """Finds readings in bytes. It holds settings, but no state."""

    def parse(self, data: bytes, final: bool = False) -> Parsed:
        """Find all readings in `data`.

        A possible beginning of a frame remains unconsumed; it is never longer than the longest
        frame. With `final`, nothing follows (a datagram): all bytes are consumed, and those outside
        frames are counted. Splitting the same bytes differently, each piece preceded by the
        unconsumed rest of the previous one, gives the same readings and counts.

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
    """Origin of the bytes, if the transport knows it: an MQTT topic, a UDP address."""


class Transport(Protocol):
    """Moves bytes.

    No method except `close` is called before `open`, or from two threads at the same time.
    """

    whole: bool
    """Whether each chunk is a complete message (a datagram), so that no frame spans two chunks."""
    counts: Counter[str]
    """Number of losses by cause, such as 'empty datagrams'."""

    def open(self) -> None:
        """Open the connection.

        Raises
        ------
        DeviceError
            If it cannot be opened. The message states the remedy, and nothing remains open.
        """

    def read(self, timeout_s: float) -> list[Chunk]:
        """Return received data, without waiting if there is any.

        Parameters
        ----------
        timeout_s : float, s
            Maximum time to wait for data.

        Returns
        -------
        list of Chunk
            Empty if nothing arrived in time.

        Raises
        ------
        DeviceError
            If the connection is lost.
        """

    def close(self) -> None:
        """Close the connection. May be called twice, and before `open`."""


class Arrival(NamedTuple):
    """Reading with its time of arrival."""

    arrival_ns: int
    """`time.monotonic_ns()` at arrival."""
    reading: Reading
    source: str = ''
    """Source of its `Chunk`. All readings of one source share one clock."""


class Device(Protocol):
    """Returns readings; otherwise like `Transport`."""

    @property
    def counts(self) -> Counter[str]:
        """Number of losses by cause."""

    def open(self) -> None:
        """Open the device.

        Raises
        ------
        DeviceError
            If it cannot be opened. The message states the remedy, and nothing remains open.
        """

    def read(self, timeout_s: float) -> list[Arrival]:
        """Return received readings, without waiting if there are any.

        Parameters
        ----------
        timeout_s : float, s
            Maximum time to wait for a reading.

        Returns
        -------
        list of Arrival
            Empty if nothing arrived in time.

        Raises
        ------
        DeviceError
            If the connection is lost.
        """

    def close(self) -> None:
        """Close the device. May be called twice, and before `open`."""
