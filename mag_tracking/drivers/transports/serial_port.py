"""Transport over a serial line: USB adapters, USB boards, RS-232 and RS-485 ports.

The transport returns a stream of bytes, in which the framing finds the readings. Data received
before `open` are discarded, so the first bytes may belong to an incomplete frame.

Sources: termios back end of pyserial 3.5; TIOCGICOUNT of Linux (ioctl_tty(2), and `struct
serial_icounter_struct` in linux/serial.h) for losses on the line and in the driver. A
pseudo-terminal has no such counters, and no losses.
"""

import errno
import fcntl
import struct
import termios
from collections import Counter
from dataclasses import dataclass

import serial
from serial.tools import list_ports

from mag_tracking.drivers.reading import Chunk
from mag_tracking.drivers.transports.polled import Polled
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import param

TIOCGICOUNT = 0x545D
ICOUNTER = struct.Struct('20i')
LINE_ERRORS = {
    6: 'framing errors on the line (check the baud rate)',
    7: 'bytes lost to receiver overruns',
    8: 'parity errors on the line',
    9: 'break conditions on the line',
    10: 'bytes lost to driver buffer overruns',
}
"""{index in `struct serial_icounter_struct`: cause}."""


@dataclass(frozen=True)
class SerialSettings:
    """Settings of a serial line with 8 data bits and no flow control."""

    port: str = param(
        '', 'Path of the port, such as /dev/ttyUSB0. The links in /dev/serial/by-id keep their '
        'names when an adapter is plugged into another USB port.')
    baud: int = param(115200, 'Baud rate.', 'bit/s', (50, 20_000_000))
    parity: str = param('N', 'Parity: N (none), E (even) or O (odd).')
    stop_bits: int = param(1, 'Number of stop bits.', '', (1, 2))
    exclusive: bool = param(True, 'Whether to open the port for exclusive use.')


class SerialPort(Polled[serial.Serial]):
    """Bytes of a serial line as a `reading.Transport`."""

    SETTINGS = SerialSettings
    is_message_oriented = False

    def __init__(self, settings: SerialSettings) -> None:
        super().__init__()
        if not settings.port:
            raise SettingsError('port: the path of a serial port is required, such as /dev/ttyUSB0')
        if settings.parity not in ('N', 'E', 'O'):
            raise SettingsError(f'parity: expected N, E or O, got {settings.parity!r}')
        self.counts: Counter[str] = Counter()
        self._settings = settings
        self._line_errors: tuple[int, ...] | None = None

    def open(self) -> None:
        """Open the port."""
        s = self._settings
        with self._lock:
            self._release()
            try:
                # Opening discards the data received so far.
                opened = serial.Serial(
                    s.port, s.baud, parity=s.parity, stopbits=s.stop_bits, timeout=0,
                    exclusive=s.exclusive or None)
            except (OSError, ValueError, termios.error) as error:
                raise DeviceError(f'serial port {s.port}: {self._open_error(error)}') from error
            self._attach(opened)
            try:
                self._line_errors = _line_errors_of(opened)
            except OSError:
                # Many drivers, and all pseudo-terminals, have no error counters.
                self._line_errors = None

    def _open_error(self, error: Exception) -> str:
        code = getattr(error, 'errno', None)
        if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            available = ', '.join(f'{p.device} ({p.description})' for p in list_ports.comports())
            return ('not found; '
                    f'{f"available ports: {available}" if available else "no ports available"}')
        if code in (errno.EACCES, errno.EPERM):
            return ('no permission; add your user to the group dialout (sudo usermod -aG dialout '
                    '$USER) and log in again')
        if code in (errno.EBUSY, errno.EAGAIN):
            return 'in use by another program'
        if isinstance(error.__context__, termios.error) or code == errno.EISDIR:
            return f'not a serial port, or no device is connected to it ({error})'
        return f'cannot be opened at {self._settings.baud} bit/s: {error}'

    def read(self, timeout_s: float) -> list[Chunk]:
        """Return the available bytes as one chunk, whose arrival is the time of the wake-up."""
        with self._lock:
            if self._handle is None:
                raise DeviceError(f'serial port {self._settings.port}: not open')
            try:
                arrival_ns = self._wait(timeout_s)
                if (before := self._line_errors) is not None:
                    self._line_errors = now = _line_errors_of(self._handle)
                    self.counts.update({cause: (now[i] - before[i]) % 2**32
                                        for i, cause in LINE_ERRORS.items() if now[i] != before[i]})
                if arrival_ns is None:
                    return []
                data = self._handle.read(max(1, self._handle.in_waiting))
            except OSError as error:
                raise DeviceError(f'serial port {self._settings.port}: connection lost; check '
                                  f'that the device is plugged in ({error})') from error
        return [Chunk(arrival_ns, data)] if data else []


def _line_errors_of(port: serial.Serial) -> tuple[int, ...]:
    """Read the kernel's error counters; raises OSError if the driver has none."""
    return ICOUNTER.unpack(fcntl.ioctl(port.fileno(), TIOCGICOUNT, bytes(ICOUNTER.size)))
