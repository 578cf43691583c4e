"""Transport over UDP (IPv4), in which each datagram is a message.

The kernel measures the arrival time (SO_TIMESTAMPNS), so it does not depend on when this process
runs. It is converted to the monotonic clock by the difference of the clocks, which is constant
unless the wall clock is set, because fine adjustments change the rate of both. If the difference
has changed since the queue was last empty, the wake-up time of the thread is used instead, and the
datagram is counted. For a few milliseconds after the first socket of the machine has requested
timestamps, the kernel returns the time of the read access.

Datagrams dropped because of a full buffer are read from the counter of the socket (SO_MEMINFO).
SO_RXQ_OVFL is delivered with the next datagram and therefore misses the last losses.

Sources: socket(7), ip(7) and udp(7) of Linux; order of the counters: SK_MEMINFO_* of
linux/sock_diag.h, described in sock_diag(7).
"""

import errno
import ipaddress
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from mag_tracking.drivers.reading import Chunk
from mag_tracking.drivers.transports.polled import Polled
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import param

MAX_DATAGRAMS_PER_READ = 1000
CLOCK_SET_NS = 1_000_000
"""[ns] A larger change of the clock difference indicates that the wall clock was set."""
SO_TIMESTAMPNS = getattr(socket, 'SO_TIMESTAMPNS', 35)
SO_MEMINFO = 55
MEMINFO = struct.Struct('9I')
DROPS_INDEX = 8
TIMESPEC = struct.Struct('ll')
Ancillary: TypeAlias = tuple[int, int, bytes]
"""Level, type and data of a control message received with a datagram."""


@dataclass(frozen=True)
class UdpSettings:
    """Settings of a UDP socket."""

    address: str = param(
        '0.0.0.0', 'Local address to listen on; 0.0.0.0 selects all interfaces. If `group` is set, '
        'this address selects the interface that joins the group, and 0.0.0.0 leaves the choice to '
        'the routing table.')
    port: int = param(0, 'Local port to listen on; required.', '', (1, 65535))
    group: str = param(
        '', 'Multicast group to join, such as 239.1.2.3. If set, only datagrams sent to the group '
        'are received.')
    sources: tuple[str, ...] = param(
        ('',), 'Addresses from which datagrams are accepted; an empty address accepts all.')
    source_port: bool = param(
        False, 'Whether the source of a datagram is address:port instead of the address.')
    receive_buffer: int = param(
        212992, "Size of the kernel's receive buffer, including an overhead of about 0.5 KiB per "
        'datagram. The kernel limits it to net.core.rmem_max.', 'bytes', (2048, 1 << 30))
    max_length: int = param(
        65507, 'Maximum length of a datagram; longer datagrams are dropped.', 'bytes', (1, 65507))


def clock_difference() -> int | None:
    """Wall clock minus monotonic clock, ns; None if the measurement was too slow."""
    measurements = []
    for _ in range(3):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        measurements.append((after - before, wall - (before + after) // 2))
    duration, difference = min(measurements)
    return difference if duration < CLOCK_SET_NS else None


class UdpSocket(Polled[socket.socket]):
    """Datagrams as chunks of a `reading.Transport`, whose source is the address of the sender.

    `report` is called if the kernel limits the receive buffer.
    """

    SETTINGS = UdpSettings
    is_message_oriented = True

    def __init__(self, settings: UdpSettings, report: Callable[[str], object] = print) -> None:
        super().__init__()
        if settings.port == 0:
            raise SettingsError('port: the number of a UDP port is required, such as 5005')
        self._sources = frozenset(settings.sources) - {''}
        for name, address in [('address', settings.address), ('group', settings.group or '0.0.0.0'),
                              *(('sources', source) for source in sorted(self._sources))]:
            try:
                ipaddress.IPv4Address(address)
            except ValueError:
                raise SettingsError(
                    f'{name}: expected an IPv4 address, got {address!r}') from None
        self.counts: Counter[str] = Counter()
        self.settings, self._report = settings, report
        self._any_source = '' in settings.sources
        self._name = f'UDP {settings.address}:{settings.port}' + (
            f', group {settings.group}' if settings.group else '')
        self._difference: int | None = None
        self._drops = 0

    def open(self) -> None:
        """Bind the socket, and join the group if one is configured."""
        with self._lock:
            self._release()
            opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                self._set_up(opened)
            except OSError as error:
                opened.close()
                raise DeviceError(f'{self._name}: {self._open_error(error)}') from error
            self._drops, self._difference = 0, clock_difference()
            self._attach(opened)

    def _set_up(self, opened: socket.socket) -> None:
        """Set the options and bind. Binding is last, because a bound socket receives datagrams."""
        s = self.settings
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, s.receive_buffer)
        # The kernel doubles the requested size for its overhead, and returns the doubled size.
        buffer_size = opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
        if buffer_size < s.receive_buffer:
            self._report(f'{self._name}: the kernel limits the receive buffer to '
                         f'{buffer_size} bytes instead of {s.receive_buffer}; increase '
                         'net.core.rmem_max')
        if s.group:
            # Several programs may listen to a group. Binding to it excludes all other datagrams.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP,
                              socket.inet_aton(s.group) + socket.inet_aton(s.address))
        opened.bind((s.group or s.address, s.port))

    def _open_error(self, error: OSError) -> str:
        s = self.settings
        if error.errno == errno.EADDRINUSE:
            return 'the port is in use by another program; choose another port'
        if error.errno == errno.EACCES:
            return 'no permission; ports below 1024 are reserved; choose another port'
        if s.group and not ipaddress.IPv4Address(s.group).is_multicast:
            return f'{s.group} is not a multicast group (224.0.0.0 to 239.255.255.255)'
        if error.errno in (errno.EADDRNOTAVAIL, errno.ENODEV):
            return (f'no interface has the address {s.address}, or there is no route to the group; '
                    f'check with `ip address` and `ip route`')
        return f'cannot be opened: {error.strerror}'

    def read(self, timeout_s: float) -> list[Chunk]:
        """Return up to `MAX_DATAGRAMS_PER_READ` available datagrams; wait for the first one."""
        with self._lock:
            if self._handle is None:
                raise DeviceError(f'{self._name}: not open')
            try:
                woken_ns = self._wait(timeout_s)
                chunks = [] if woken_ns is None else self._drain(self._handle, woken_ns)
                self._count_drops(self._handle)
            except OSError as error:
                raise DeviceError(f'{self._name}: {error}') from error
        return chunks

    def _drain(self, opened: socket.socket, woken_ns: int) -> list[Chunk]:
        datagrams: list[tuple[bytes, list[Ancillary], int, tuple[str, int]]] = []
        is_empty = False
        ancillary_size = socket.CMSG_SPACE(TIMESPEC.size)
        while len(datagrams) < MAX_DATAGRAMS_PER_READ and not is_empty:
            try:
                datagrams.append(opened.recvmsg(self.settings.max_length, ancillary_size))
            except BlockingIOError:
                is_empty = True
        difference = clock_difference()
        is_usable = (difference is not None and self._difference is not None
                     and abs(difference - self._difference) < CLOCK_SET_NS)
        if is_empty:
            # Queued datagrams have the old difference, which is kept until the queue is empty.
            self._difference = difference
        return [Chunk(self._arrival(ancillary, difference if is_usable else None, woken_ns), data,
                      f'{ip}:{port}' if self.settings.source_port else ip)
                for data, ancillary, flags, (ip, port) in datagrams
                if self._accept(data, flags, ip)]

    def _accept(self, data: bytes, flags: int, ip: str) -> bool:
        if not self._any_source and ip not in self._sources:
            cause = 'datagrams from other sources'
        elif flags & socket.MSG_TRUNC:
            cause = 'datagrams longer than max_length'
        else:
            cause = '' if data else 'empty datagrams'
        self.counts.update([cause] if cause else [])
        return not cause

    def _arrival(self, ancillary: list[Ancillary], difference: int | None, woken_ns: int) -> int:
        """Monotonic arrival time of a datagram, ns, from the timestamp in `ancillary`; `woken_ns`
        without a timestamp or `difference`."""
        if difference is not None:
            for level, kind, data in ancillary:
                if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                    seconds, ns = TIMESPEC.unpack(data)
                    arrival_ns: int = seconds * 1_000_000_000 + ns - difference
                    return arrival_ns
        self.counts['datagrams timestamped at wake-up instead of by the kernel'] += 1
        return woken_ns

    def _count_drops(self, opened: socket.socket) -> None:
        drops = MEMINFO.unpack(
            opened.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size))[DROPS_INDEX]
        if drops != self._drops:
            self.counts['datagrams dropped by the kernel'] += (drops - self._drops) % 2**32
            self._drops = drops
