"""A serial line: USB adapters, USB boards, RS-232 and RS-485 ports.

Bytes come without borders; where a reading begins is the framing's business. What
the port held before it was opened is thrown away, so the first bytes may be the
rest of a frame, and every byte is younger than `open`.

Sources: the termios of pyserial 3.5; TIOCGICOUNT of Linux (ioctl_tty(2), and
`struct serial_icounter_struct` in linux/serial.h) for what the line and the driver
lost. A pseudo-terminal does not count, and loses nothing.
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
    6: 'framing errors on the line (is the baud rate right?)',
    7: 'bytes lost, overrun of the receiver',
    8: 'parity errors on the line',
    9: 'breaks on the line',
    10: 'bytes lost, overrun of the driver\'s buffer',
}
"""{index in `struct serial_icounter_struct`: cause}."""


@dataclass(frozen=True)
class SerialSettings:
    """Settings of a serial line; 8 data bits, no flow control."""

    port: str = param(
        '', 'Path of the port, such as /dev/ttyUSB0; the links below /dev/serial/by-id keep their '
        'names when plugs change places.')
    baud: int = param(115200, 'Speed of the line.', 'bit/s', (50, 20_000_000))
    parity: str = param('N', 'N = none, E = even, O = odd.')
    stop_bits: int = param(1, 'Stop bits.', '', (1, 2))
    exclusive: bool = param(
        True, 'No other program that asks for the port alone gets it at the same time.')


class SerialPort(Polled[serial.Serial]):
    """Transport over a serial line; see `reading.Transport`.

    Raises SettingsError where no port is named, or where the parity is none of the three.
    `counts` has the errors of the line as the kernel counts them, where the driver of the port
    does.
    """

    SETTINGS = SerialSettings
    whole = False

    def __init__(self, settings: SerialSettings) -> None:
        super().__init__()
        if not settings.port:
            raise SettingsError('port: the path of a serial port is needed')
        if settings.parity not in ('N', 'E', 'O'):
            raise SettingsError(f'parity: expected N, E or O, got {settings.parity!r}')
        self.counts: Counter[str] = Counter()
        self._settings = settings
        self._line_errors: tuple[int, ...] | None = None

    def open(self) -> None:
        """Open the port; raises DeviceError where it is not there, busy or not allowed."""
        s = self._settings
        with self._lock:
            self._release()
            try:
                # Opening flushes what the port has received so far.
                opened = serial.Serial(
                    s.port, s.baud, parity=s.parity, stopbits=s.stop_bits, timeout=0,
                    exclusive=s.exclusive or None)
            except (OSError, ValueError, termios.error) as error:
                raise DeviceError(f'serial port {s.port}: {self._obstacle(error)}') from error
            self._hold(opened)
            try:
                self._line_errors = _line_errors_of(opened)
            except OSError:
                # Many drivers, and all pseudo-terminals, do not count.
                self._line_errors = None

    def _obstacle(self, error: Exception) -> str:
        """What stands in the way, and what to do."""
        code = getattr(error, 'errno', None)
        if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            there = ', '.join(f'{p.device} ({p.description})' for p in list_ports.comports())
            return f'is not there; {f"there are {there}" if there else "there is no other either"}'
        if code in (errno.EACCES, errno.EPERM):
            return ('no permission; ports belong to the group dialout: sudo usermod -aG dialout '
                    '$USER, and log in again')
        if code in (errno.EBUSY, errno.EAGAIN):
            return 'is in use by another program'
        if isinstance(error.__context__, termios.error) or code == errno.EISDIR:
            return f'is not a serial port, or there is no device behind it ({error})'
        return f'cannot be opened with {self._settings.baud} bit/s: {error}'

    def read(self, timeout_s: float) -> list[Chunk]:
        """At most one chunk: what is there as soon as something is; its time is the wake-up's.

        Returns [] where nothing comes in time, or where `close` is called meanwhile.
        Raises DeviceError where the port is not open or is gone.
        """
        with self._lock:
            if self._handle is None:
                raise DeviceError(f'serial port {self._settings.port}: is not open')
            try:
                arrival_ns = self._wait(timeout_s)
                if self._line_errors is not None:
                    before, self._line_errors = self._line_errors, _line_errors_of(self._handle)
                    self._count_line_errors(before, self._line_errors)
                if arrival_ns is None:
                    return []
                data = self._handle.read(max(1, self._handle.in_waiting))
            except OSError as error:
                raise DeviceError(f'serial port {self._settings.port}: is gone, perhaps unplugged '
                                  f'({error})') from error
        return [Chunk(arrival_ns, data)] if data else []

    def _count_line_errors(self, before: tuple[int, ...], now: tuple[int, ...]) -> None:
        """Add what the line and the driver lost between two looks at the kernel's counters."""
        for i, cause in LINE_ERRORS.items():
            if now[i] != before[i]:
                self.counts[cause] += (now[i] - before[i]) % 2**32


def _line_errors_of(port: serial.Serial) -> tuple[int, ...]:
    """The kernel's counters; raises OSError where the driver of the port has none."""
    return ICOUNTER.unpack(fcntl.ioctl(port.fileno(), TIOCGICOUNT, bytes(ICOUNTER.size)))
