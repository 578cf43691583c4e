"""UDP over IPv4: each datagram is a message of its own.

A datagram's time is the kernel's own (SO_TIMESTAMPNS), which does not depend on when this
process gets to run. It is of the wall clock, and is moved to the monotonic clock by their
difference, which is constant unless the wall clock is set: the system's fine tuning turns
both. So where the difference has changed since the queue was last empty, the time of the
wake-up is taken instead, and that is counted. In the first milliseconds after the first
socket of the machine asks for its times, the kernel gives that of the reading instead.

What the kernel dropped because the buffer was full is read from the socket's own counter
(SO_MEMINFO). Unlike SO_RXQ_OVFL, which comes with the next datagram, it is right also where no
further one comes.

Sources: socket(7), ip(7) and udp(7) of Linux; the order of the counters: SK_MEMINFO_* of
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

AT_ONCE = 1000
"""Datagrams that one `read` gives at most."""
CLOCK_SET_NS = 1_000_000
"""A change of the clocks' difference by more is no error of measuring it."""
SO_TIMESTAMPNS = getattr(socket, 'SO_TIMESTAMPNS', 35)
SO_MEMINFO = 55
MEMINFO = struct.Struct('9I')
DROPS = 8
TIMESPEC = struct.Struct('ll')
Ancillary: TypeAlias = tuple[int, int, bytes]
"""Level, type and data of what comes beside a datagram."""


@dataclass(frozen=True)
class UdpSettings:
    """Settings of a UDP socket."""

    address: str = param(
        '0.0.0.0', 'Address of this machine to listen at; 0.0.0.0 = all. With a group: that of '
        'the interface to join it on, 0.0.0.0 = as the routes say.')
    port: int = param(0, 'Port to listen at; it must be set.', '', (1, 65535))
    group: str = param('', 'Multicast group to join, such as 239.1.2.3; nothing that is not sent '
                       'to it is received then.')
    sources: tuple[str, ...] = param(
        ('',), 'Addresses whose datagrams are taken; an empty one stands for all.')
    source_port: bool = param(
        False, 'The source of a datagram is address:port instead of the address.')
    receive_buffer: int = param(
        212992, 'What the kernel holds for this program while it does not get to run, overhead of '
        'each datagram (about 0.5 KiB) included; more than net.core.rmem_max is not given.',
        'bytes', (2048, 1 << 30))
    max_length: int = param(65507, 'A longer datagram is dropped.', 'bytes', (1, 65507))


def clock_difference() -> int | None:
    """Wall clock less monotonic clock [ns], of three tries the one that took least.

    None where even that one took too long to tell anything.
    """
    tries = []
    for _ in range(3):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        tries.append((after - before, wall - (before + after) // 2))
    took, difference = min(tries)
    return difference if took < CLOCK_SET_NS else None


class UdpSocket(Polled[socket.socket]):
    """Transport over UDP; see `reading.Transport`. One chunk per datagram, its source an address.

    Parameters
    ----------
    settings : UdpSettings
    report : function
        Takes a line of text for the user: that the kernel gave less buffer than asked for.

    Raises SettingsError where an address or the port is none.
    """

    SETTINGS = UdpSettings
    whole = True

    def __init__(self, settings: UdpSettings, report: Callable[[str], object] = print) -> None:
        super().__init__()
        if settings.port == 0:
            raise SettingsError('port: the number of a UDP port is needed')
        self._sources = frozenset(settings.sources) - {''}
        for name, address in [('address', settings.address), ('group', settings.group or '0.0.0.0'),
                              *(('sources', source) for source in sorted(self._sources))]:
            try:
                ipaddress.IPv4Address(address)
            except ValueError:
                raise SettingsError(
                    f'{name}: expected an IPv4 address, got {address!r}') from None
        self.counts: Counter[str] = Counter()
        self._settings, self._report = settings, report
        self._any_source = '' in settings.sources
        self._difference: int | None = None
        self._drops = 0

    @property
    def settings(self) -> UdpSettings:
        """As they were given."""
        return self._settings

    def open(self) -> None:
        """Bind, and join the group; raises DeviceError where the system refuses."""
        with self._lock:
            self._release()
            opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                self._set_up(opened)
            except OSError as error:
                opened.close()
                raise DeviceError(f'UDP {self._where()}: {self._obstacle(error)}') from error
            self._drops, self._difference = 0, clock_difference()
            self._hold(opened)

    def _set_up(self, opened: socket.socket) -> None:
        """Options first: from `bind` on datagrams come."""
        s = self._settings
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, s.receive_buffer)
        # The kernel doubles what it is asked for, for its overhead, and says the double.
        given = opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
        if given < s.receive_buffer:
            self._report(f'UDP {self._where()}: the kernel gave a receive buffer of {given} bytes '
                         f'instead of {s.receive_buffer}; raise net.core.rmem_max')
        if s.group:
            # Several programs may listen to a group; to be bound to it keeps all else out.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP,
                              socket.inet_aton(s.group) + socket.inet_aton(s.address))
        opened.bind((s.group or s.address, s.port))

    def _where(self) -> str:
        """The end of the line, for messages."""
        s = self._settings
        return f'{s.address}:{s.port}' + (f', group {s.group}' if s.group else '')

    def _obstacle(self, error: OSError) -> str:
        """What stands in the way, and what to do."""
        s = self._settings
        if error.errno == errno.EADDRINUSE:
            return 'the port is in use by another program'
        if error.errno == errno.EACCES:
            return 'no permission; ports below 1024 are the system\'s'
        if s.group and not ipaddress.IPv4Address(s.group).is_multicast:
            return f'{s.group} is no multicast group; those are 224.0.0.0 to 239.255.255.255'
        if error.errno in (errno.EADDRNOTAVAIL, errno.ENODEV):
            return (f'no interface of this machine has the address {s.address}, or none leads to '
                    f'the group; see `ip address`')
        return f'cannot be opened: {error.strerror}'

    def read(self, timeout_s: float) -> list[Chunk]:
        """The datagrams that are there, `AT_ONCE` at most, as soon as there is one.

        Returns [] where nothing comes in time, or where `close` is called meanwhile.
        Raises DeviceError where the socket is not open or fails.
        """
        with self._lock:
            if self._handle is None:
                raise DeviceError(f'UDP {self._where()}: is not open')
            try:
                woken_ns = self._wait(timeout_s)
                chunks = [] if woken_ns is None else self._drain(self._handle, woken_ns)
                self._count_drops(self._handle)
            except OSError as error:
                raise DeviceError(f'UDP {self._where()}: {error}') from error
        return chunks

    def _drain(self, opened: socket.socket, woken_ns: int) -> list[Chunk]:
        """Chunks of what is in the queue."""
        came: list[tuple[bytes, list[Ancillary], int, tuple[str, int]]] = []
        empty = False
        room = socket.CMSG_SPACE(TIMESPEC.size)
        while len(came) < AT_ONCE and not empty:
            try:
                came.append(opened.recvmsg(self._settings.max_length, room))
            except BlockingIOError:
                empty = True
        difference = clock_difference()
        usable = (difference is not None and self._difference is not None
                  and abs(difference - self._difference) < CLOCK_SET_NS)
        if empty:
            # Whatever is still in the queue is measured against the time before it came.
            self._difference = difference
        return [Chunk(self._arrival(ancillary, difference if usable else None, woken_ns), data,
                      f'{ip}:{port}' if self._settings.source_port else ip)
                for data, ancillary, flags, (ip, port) in came if self._accept(data, flags, ip)]

    def _accept(self, data: bytes, flags: int, ip: str) -> bool:
        """Whether a datagram is handed on; one that is not is counted."""
        if not self._any_source and ip not in self._sources:
            self.counts['datagrams from other sources'] += 1
        elif flags & socket.MSG_TRUNC:
            self.counts['datagrams that were too long'] += 1
        elif not data:
            self.counts['empty datagrams'] += 1
        else:
            return True
        return False

    def _arrival(self, ancillary: list[Ancillary], difference: int | None, woken_ns: int) -> int:
        """When a datagram came, by the monotonic clock [ns]."""
        if difference is not None:
            for level, kind, data in ancillary:
                if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                    seconds, ns = TIMESPEC.unpack(data)
                    arrival_ns: int = seconds * 1_000_000_000 + ns - difference
                    return arrival_ns
        self.counts['datagrams with the time of the wake-up instead of the kernel\'s'] += 1
        return woken_ns

    def _count_drops(self, opened: socket.socket) -> None:
        """Add what the kernel has dropped since last time."""
        drops = MEMINFO.unpack(
            opened.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size))[DROPS]
        if drops != self._drops:
            self.counts['datagrams dropped by the kernel'] += (drops - self._drops) % 2**32
            self._drops = drops
