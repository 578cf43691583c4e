"""Serial ports over real pseudo-terminals; only the kernel's error counters are simulated."""

import fcntl
import math
import os
import select
import struct
import subprocess
import sys
import termios
import threading
import time
import tty
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import serial

from mag_tracking.drivers.transports import serial_port
from mag_tracking.drivers.transports.serial_port import SerialPort, SerialSettings
from mag_tracking.errors import DeviceError, SettingsError
from support.counters import count_of

ROOT = Path(__file__).resolve().parents[3]


class Device:
    """Device at the other end of a pseudo-terminal, with a permanent link to its port."""

    def __init__(self, folder):
        self.link = folder / 'magnetometer'
        self.master = None
        self.plug()

    def plug(self):
        """Create a new port under the same link."""
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        # This end stays open: the device exists whether or not a program reads it.
        self.slave = slave
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(self.path)

    def unplug(self):
        """Remove the port."""
        for end in (self.master, self.slave):
            with suppress(OSError):
                os.close(end)

    def wait_for(self, n):
        """Wait until `n` bytes are available at the port."""
        end = time.monotonic() + 60.0
        while time.monotonic() < end:
            if struct.unpack('i', fcntl.ioctl(self.slave, termios.FIONREAD, bytes(4)))[0] == n:
                return
            time.sleep(0.001)
        raise AssertionError(f'{n} bytes have not arrived')

    def write(self, data):
        while data:
            data = data[os.write(self.master, data):]


@pytest.fixture
def device(tmp_path):
    created = Device(tmp_path)
    yield created
    created.unplug()


@pytest.fixture
def handles(monkeypatch):
    """Ports opened by pyserial, in the order of opening."""
    created = []

    class Recorded(serial.Serial):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            created.append(self)

    monkeypatch.setattr(serial, 'Serial', Recorded)
    return created


@pytest.fixture
def port(device):
    opened = SerialPort(SerialSettings(port=str(device.link)))
    opened.open()
    yield opened
    opened.close()


def open_error(port):
    with pytest.raises(DeviceError) as caught:
        port.open()
    return str(caught.value)


def read_bytes(port, n, seconds=60.0):
    data, end = b'', time.monotonic() + seconds
    while len(data) < n and time.monotonic() < end:
        data += b''.join(chunk.data for chunk in port.read(0.2))
    return data


def test_a_million_bytes_arrive_complete_and_in_order(device, port):
    sent = os.urandom(1_000_000)
    writer = threading.Thread(target=device.write, args=(sent,))
    writer.start()
    assert read_bytes(port, len(sent), 20.0) == sent
    writer.join()
    assert not port.counts and not port.is_message_oriented


def test_every_byte_arrives_unchanged(device, port):
    """No byte is translated, treated as a control character or echoed."""
    sent = bytes(range(256)) * 3
    device.write(sent)
    assert read_bytes(port, len(sent)) == sent
    assert not select.select([device.master], [], [], 0.05)[0]


def test_available_bytes_are_returned_at_once_as_one_chunk(device, port):
    device.write(b'a first line\n')
    device.write(b'and half of')
    # The kernel transfers the bytes asynchronously.
    device.wait_for(24)
    start = time.monotonic()
    chunk, = port.read(20.0)
    assert time.monotonic() - start < 20.0
    assert chunk.data == b'a first line\nand half of' and chunk.source == ''


def test_read_returns_at_its_timeout(port):
    for timeout in (0.0, 0.03, 0.1):
        durations = [math.inf]
        # The machine may be busy during some attempts, but not during all of them.
        while min(durations) >= timeout + 0.04 and len(durations) < 100:
            start = time.monotonic()
            assert port.read(timeout) == []
            durations.append(time.monotonic() - start)
        assert timeout <= min(durations) < timeout + 0.04


def test_the_arrival_time_is_that_of_the_wake_up(device, port):
    threading.Timer(0.3, device.write, (b'x',)).start()
    start = time.monotonic_ns()
    chunk, = port.read(60.0)
    assert 0.28e9 < chunk.arrival_ns - start
    assert chunk.arrival_ns <= time.monotonic_ns()


def test_bytes_received_before_opening_are_discarded(device):
    device.write(b'lf a frame\n')
    device.wait_for(11)
    port = SerialPort(SerialSettings(port=device.path))
    port.open()
    device.write(b'a whole one\n')
    assert read_bytes(port, 12) == b'a whole one\n'
    port.close()


def test_an_unplugged_device_is_reported(device, port):
    device.write(b'x')
    assert read_bytes(port, 1) == b'x'
    device.unplug()
    start = time.monotonic()
    for _ in range(2):
        with pytest.raises(DeviceError, match=f'serial port {device.link}: connection lost'):
            port.read(20.0)
    assert time.monotonic() - start < 20.0


def test_unplugging_ends_a_waiting_read_at_once(device, port):
    threading.Timer(0.2, device.unplug).start()
    start = time.monotonic()
    with pytest.raises(DeviceError, match='connection lost'):
        port.read(20.0)
    assert time.monotonic() - start < 20.0


def test_a_device_can_be_reopened_after_it_was_plugged_in_again(device, port):
    for text in (b'once', b'twice'):
        device.unplug()
        device.link.unlink()
        with pytest.raises(DeviceError):
            port.read(1.0)
        port.close()
        assert 'not found' in open_error(port)
        device.plug()
        port.open()
        device.write(text)
        assert read_bytes(port, len(text)) == text


def test_the_error_of_a_missing_port_lists_the_available_ports(monkeypatch):
    port = SerialPort(SerialSettings(port='/dev/ttyNONE0'))
    monkeypatch.setattr(serial_port.list_ports, 'comports', list)
    assert '/dev/ttyNONE0: not found; no ports' in open_error(port)

    class Known:
        device, description = '/dev/ttyUSB7', 'FT232R'

    monkeypatch.setattr(serial_port.list_ports, 'comports', lambda: [Known, Known])
    assert open_error(port).endswith(
        'available ports: /dev/ttyUSB7 (FT232R), /dev/ttyUSB7 (FT232R)')


def test_a_missing_permission_is_reported_with_the_remedy(device):
    os.chmod(device.path, 0)
    code = ('import os, sys\n'
            'from mag_tracking.errors import DeviceError\n'
            'from mag_tracking.drivers.transports.serial_port import SerialPort, SerialSettings\n'
            'if os.geteuid() == 0:\n'
            '    os.setgroups([])\n'
            '    os.setgid(65534)\n'
            '    os.setuid(65534)\n'
            'try:\n'
            '    SerialPort(SerialSettings(port=sys.argv[1])).open()\n'
            'except DeviceError as error:\n'
            '    print(error)\n')
    output = subprocess.run([sys.executable, '-c', code, device.path], cwd=ROOT, text=True,
                            capture_output=True, check=True, timeout=60).stdout
    assert output.startswith(f'serial port {device.path}: no permission; ')
    assert 'usermod -aG dialout' in output


def test_a_port_in_use_is_reported(device, port):
    other = SerialPort(SerialSettings(port=device.path))
    assert f'{device.path}: in use' in open_error(other)
    # The refused program leaves the port unchanged, and can open it once it is free.
    device.write(b'x')
    assert read_bytes(port, 1) == b'x'
    port.close()
    other.open()
    other.close()


def test_a_port_may_be_shared_if_not_exclusive(device, port):
    other = SerialPort(SerialSettings(port=device.path, exclusive=False))
    other.open()
    device.write(b'x')
    assert read_bytes(other, 1) == b'x'
    other.close()


def test_paths_that_are_no_serial_port_are_refused(tmp_path):
    (tmp_path / 'file').write_text('text')
    for path in (tmp_path / 'file', tmp_path, Path('/dev/null')):
        message = open_error(SerialPort(SerialSettings(port=str(path))))
        assert f'{path}: not a' in message


def test_a_failed_open_leaves_no_file_descriptor(device, port, tmp_path):
    before = len(os.listdir('/proc/self/fd'))
    for path in (device.path, '/dev/null', '/dev/ttyNONE0', str(tmp_path)):
        open_error(SerialPort(SerialSettings(port=path)))
    assert len(os.listdir('/proc/self/fd')) == before
    for _ in range(5):
        port.open()
    port.close()
    assert len(os.listdir('/proc/self/fd')) == before - 5


@pytest.mark.parametrize('parity, flags', [
    ('N', 0), ('E', termios.PARENB), ('O', termios.PARENB | termios.PARODD)])
@pytest.mark.parametrize('stop_bits', [1, 2])
def test_baud_rate_parity_and_stop_bits_are_set(device, monkeypatch, parity, flags, stop_bits):
    requested, set_attributes = [], termios.tcsetattr

    def record(fd, when, attributes):
        requested.append(attributes[2])
        set_attributes(fd, when, attributes)

    monkeypatch.setattr(termios, 'tcsetattr', record)
    port = SerialPort(SerialSettings(str(device.link), 57600, parity, stop_bits))
    port.open()
    _, _, cflag, _, ispeed, ospeed, _ = termios.tcgetattr(device.slave)
    assert ispeed == ospeed == termios.B57600
    assert cflag & termios.CSTOPB == (termios.CSTOPB if stop_bits == 2 else 0)
    # A pseudo-terminal has no parity: the kernel clears the flags that were requested.
    assert requested[-1] & (termios.PARENB | termios.PARODD) == flags
    assert cflag & termios.CSIZE == termios.CS8
    port.close()


def test_a_device_lost_during_opening_is_reported(device, monkeypatch):
    def fail(*_):
        raise termios.error(5, 'Input/output error')

    monkeypatch.setattr(termios, 'tcflush', fail)
    port = SerialPort(SerialSettings(port=device.path))
    assert 'Input/output error' in open_error(port)


def test_an_unsupported_baud_rate_is_reported(device, monkeypatch):
    def refuse(*_):
        raise ValueError('Failed to set custom baud rate (12345): [Errno 22]')

    monkeypatch.setattr('serial.Serial._set_special_baudrate', refuse)
    port = SerialPort(SerialSettings(port=device.path, baud=12345))
    assert '12345 bit/s' in open_error(port)


def test_line_errors_are_counted_from_opening_on(device, monkeypatch):
    """The counters of the kernel start at boot, and overflow."""
    real, counters = serial_port.fcntl.ioctl, [7] * 20

    def ioctl(fd, request, *args):
        if request == 0x545D:
            assert len(args[0]) == 80
            return struct.pack('20i', *counters)
        return real(fd, request, *args)

    monkeypatch.setattr(serial_port.fcntl, 'ioctl', ioctl)
    counters[9] = 2**31 - 1
    port = SerialPort(SerialSettings(port=device.path))
    port.open()
    assert port.read(0.0) == [] and not port.counts
    counters[:] = [100 + i for i in range(20)]
    counters[9] = -2**31 + 1
    counters[7] = -2**31 + 20
    device.write(b'x')
    assert [c.data for c in port.read(1.0)] == [b'x']
    lost = {'framing errors on the line (check the baud rate)': 99,
            'bytes lost to receiver overruns': 2**31 + 13, 'parity errors on the line': 101,
            'break conditions on the line': 2, 'bytes lost to driver buffer overruns': 103}
    assert port.counts == lost
    assert port.read(0.0) == [] and port.counts == lost
    # Errors are counted even if no byte arrives.
    counters[6] += 1
    assert port.read(0.0) == []
    assert count_of(port.counts, 'baud rate') == 100
    # The counters restart at zero if the port is plugged in again.
    counters[:] = [0] * 20
    port.open()
    assert port.read(0.0) == []
    assert sum(port.counts.values()) == sum(lost.values()) + 1
    # A port without counters can still be read.
    monkeypatch.undo()
    port.open()
    device.write(b'y')
    assert [c.data for c in port.read(1.0)] == [b'y']
    port.close()


def test_close_ends_a_waiting_read_and_may_be_repeated(device, handles):
    port = SerialPort(SerialSettings(port=device.path))
    port.close()
    with pytest.raises(DeviceError, match=f'{device.path}: not open'):
        port.read(0.0)
    for _ in range(2):
        port.open()
        closer = threading.Timer(0.1, port.close)
        closer.start()
        start = time.monotonic()
        assert port.read(20.0) == []
        assert 0.05 < time.monotonic() - start < 20.0
        closer.join()
        assert not handles[-1].is_open
        port.close()
        port.close()
        with pytest.raises(DeviceError, match='not open'):
            port.read(0.0)


def test_invalid_settings_are_refused():
    with pytest.raises(SettingsError, match='port: '):
        SerialPort(SerialSettings())
    for parity in ('n', '', 'M', 'EO'):
        with pytest.raises(SettingsError, match='parity: expected N, E or O'):
            SerialPort(replace(SerialSettings(port='x'), parity=parity))
