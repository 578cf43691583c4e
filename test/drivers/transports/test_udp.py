"""UDP transport over real sockets of the local machine."""

import math
import os
import socket
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace

import pytest

from mag_tracking.drivers.transports import udp as udp_socket
from mag_tracking.drivers.transports.udp import UdpSettings, UdpSocket
from mag_tracking.errors import DeviceError, SettingsError
from support.counters import assert_counts, count_of
from support.mqtt_broker import free_port

SETTINGS = UdpSettings(address='127.0.0.1')


@pytest.fixture
def listen():
    """Factory of open `UdpSocket` instances, which are closed at the end of the test."""
    created = []

    def make(report=print, **changes):
        port = free_port(socket.SOCK_DGRAM)
        created.append(UdpSocket(replace(SETTINGS, **{'port': port} | changes), report))
        created[-1].open()
        return created[-1]

    yield make
    for udp in created:
        udp.close()


@pytest.fixture
def sockets(monkeypatch):
    """Sockets created during the test, in the order of creation."""
    created = []

    class Recorded(socket.socket):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            created.append(self)

    monkeypatch.setattr(socket, 'socket', Recorded)
    return created


@pytest.fixture
def sender():
    """Function that sends datagrams to a `UdpSocket` at a loopback address."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as opened:
        opened.bind(('127.0.0.1', 0))

        def send(udp, *datagrams, to=None):
            for data in datagrams:
                opened.sendto(data, (to or '127.0.0.1', udp.settings.port))

        send.port = opened.getsockname()[1]
        yield send


def open_error(udp):
    with pytest.raises(DeviceError) as caught:
        udp.open()
    return str(caught.value)


def test_each_datagram_is_a_chunk(listen, sender):
    udp = listen()
    sent = [os.urandom(1 + 37 * i) for i in range(100)] + [os.urandom(65507)]
    sender(udp, *sent[:100])
    chunks = udp.read(60.0)
    sender(udp, sent[100])
    chunks += udp.read(60.0)
    assert [c.data for c in chunks] == sent
    assert {c.source for c in chunks} == {'127.0.0.1'}
    assert not udp.counts and udp.is_message_oriented


def test_the_source_may_include_its_port(listen, sender):
    udp = listen(source_port=True)
    sender(udp, b'x')
    assert [c.source for c in udp.read(60.0)] == [f'127.0.0.1:{sender.port}']


def test_read_returns_at_its_timeout(listen):
    udp = listen()
    for timeout in (0.0, 0.03, 0.1):
        durations = [math.inf]
        # The machine may be busy during some attempts, but not during all of them.
        while min(durations) >= timeout + 0.04 and len(durations) < 100:
            start = time.monotonic()
            assert udp.read(timeout) == []
            durations.append(time.monotonic() - start)
        assert timeout <= min(durations) < timeout + 0.04


def test_read_returns_as_soon_as_a_datagram_arrives(listen, sender):
    udp = listen()
    threading.Timer(0.2, sender, (udp, b'x')).start()
    start = time.monotonic()
    assert [c.data for c in udp.read(20.0)] == [b'x']
    assert 0.15 < time.monotonic() - start < 20.0


def test_one_read_returns_a_limited_number_of_datagrams(listen, sender, monkeypatch):
    monkeypatch.setattr(udp_socket, 'MAX_DATAGRAMS_PER_READ', 10)
    udp = listen()
    sender(udp, *(bytes([i]) for i in range(25)))
    assert [len(udp.read(0.0)) for _ in range(4)] == [10, 10, 5, 0]


def wait_for_kernel_timestamps(udp, sender):
    """Wait until the kernel timestamps datagrams at their arrival."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        sender(udp, b'x')
        time.sleep(0.01)
        now = time.monotonic_ns()
        if [c for c in udp.read(0.0) if now - c.arrival_ns > 5e6]:
            return
    raise AssertionError('datagrams are still timestamped at reading')


def test_the_arrival_time_is_that_of_reception_not_of_reading(listen, sender):
    udp = listen()
    wait_for_kernel_timestamps(udp, sender)
    between = []
    for i in range(3):
        before = time.monotonic_ns()
        sender(udp, bytes([i]))
        between.append((before, time.monotonic_ns()))
        time.sleep(0.1)
    for chunk, (before, after) in zip(udp.read(0.0), between, strict=True):
        # The comparison of the clocks is accurate to a few microseconds.
        assert before - 50_000 < chunk.arrival_ns < after + 50_000
    assert not udp.counts


WAKE_UP_TIMES = 'datagrams timestamped at wake-up instead of by the kernel'


@pytest.mark.parametrize('step_s', [-3600.0, -0.02, 0.02, 3600.0])
def test_a_step_of_the_wall_clock_does_not_shift_arrival_times(listen, sender, monkeypatch, step_s):
    udp = listen()
    sender(udp, b'before')
    real = udp_socket.clock_difference
    monkeypatch.setattr(udp_socket, 'clock_difference', lambda: real() + int(step_s * 1e9))
    monkeypatch.setattr(udp_socket, 'MAX_DATAGRAMS_PER_READ', 1)
    sender(udp, b'behind')
    for count in (1, 2):
        # The datagram was queued before the step, although another was read since then.
        woken = time.monotonic_ns()
        chunk, = udp.read(1.0)
        assert 0 <= chunk.arrival_ns - woken < 50e6
        assert udp.counts == {WAKE_UP_TIMES: count}
    # The queue was never empty so far. Once it is, the timestamps of the kernel are used again.
    monkeypatch.setattr(udp_socket, 'MAX_DATAGRAMS_PER_READ', 10)
    sender(udp, b'last')
    udp.read(1.0)
    assert udp.counts == {WAKE_UP_TIMES: 3}
    sender(udp, b'after')
    chunk, = udp.read(1.0)
    # The simulated step does not affect the kernel.
    assert chunk.arrival_ns + step_s * 1e9 == pytest.approx(time.monotonic_ns(), abs=50e6)
    assert udp.counts == {WAKE_UP_TIMES: 3}


def test_arrival_times_are_wake_up_times_if_clocks_are_not_comparable(listen, sender, monkeypatch):
    udp = listen()
    real = time.time_ns

    def slow():
        time.sleep(0.002)
        return real()

    sender(udp, b'x')
    monkeypatch.setattr(udp_socket.time, 'time_ns', slow)
    assert udp_socket.clock_difference() is None
    assert len(udp.read(1.0)) == 1
    monkeypatch.undo()
    assert udp.counts == {WAKE_UP_TIMES: 1}
    # A failed comparison is not used as a reference either.
    sender(udp, b'x')
    udp.read(1.0)
    assert udp.counts == {WAKE_UP_TIMES: 2}
    sender(udp, b'x')
    udp.read(1.0)
    assert udp.counts == {WAKE_UP_TIMES: 2}


def test_the_clock_difference_is_wall_minus_monotonic_time():
    between = time.time_ns() - time.monotonic_ns()
    assert abs(udp_socket.clock_difference() - between) < 1e6


def test_the_fastest_of_three_clock_comparisons_is_used(monkeypatch):
    mono = iter([0, 500_000, 1_000_000, 1_000_100, 2_000_000, 2_400_000])
    wall = iter([77, 5_000_050, 99])
    monkeypatch.setattr(udp_socket.time, 'monotonic_ns', lambda: next(mono))
    monkeypatch.setattr(udp_socket.time, 'time_ns', lambda: next(wall))
    assert udp_socket.clock_difference() == 5_000_050 - 1_000_050


def test_datagrams_dropped_by_the_kernel_are_counted(listen, sender):
    udp = listen(receive_buffer=20_000)
    n_received = 0
    for burst in (3, 2000, 1, 3000):
        sender(udp, *(b'x' * 50 for _ in range(burst)))
        while chunks := udp.read(0.05):
            n_received += len(chunks)
    dropped = count_of(udp.counts, 'kernel')
    assert n_received + dropped == 5004
    assert dropped > 3000 and len(udp.counts) == 1


def test_a_reader_that_keeps_up_loses_nothing(listen, sender):
    """The sender transmits up to 2500 datagrams of 200 bytes per second."""
    udp = listen()
    sent = [i.to_bytes(4, 'big') * 50 for i in range(1000)]

    def send():
        for i in range(0, 1000, 10):
            sender(udp, *sent[i:i + 10])
            time.sleep(0.004)

    thread = threading.Thread(target=send)
    thread.start()
    received, end = [], time.monotonic() + 60.0
    while len(received) < len(sent) and time.monotonic() < end:
        received += udp.read(0.1)
    thread.join()
    assert [c.data for c in received] == sent
    arrivals = [c.arrival_ns for c in received]
    # Each read compares the clocks again, with an accuracy of a few microseconds.
    assert all(b - a > -50_000 for a, b in zip(arrivals, arrivals[1:], strict=False))
    assert not udp.counts


def test_an_overflow_of_the_kernel_counter_is_handled(listen, monkeypatch):
    class Dropping(socket.socket):
        drops = 0

        def getsockopt(self, level, kind, *size):
            value = super().getsockopt(level, kind, *size)
            if kind != udp_socket.SO_MEMINFO:
                return value
            return value[:-4] + self.drops.to_bytes(4, sys.byteorder)

    monkeypatch.setattr(socket, 'socket', Dropping)
    udp = listen()
    for drops, total in ((0, 0), (2**32 - 5, 2**32 - 5), (2, 2**32 + 2)):
        Dropping.drops = drops
        assert udp.read(0.0) == []
        assert count_of(udp.counts, 'kernel') == total


def test_dropped_datagrams_add_up_over_reopening(listen, sender):
    udp = listen(receive_buffer=4096)
    for total in (100, 200):
        sender(udp, *(b'x' * 50 for _ in range(100)))
        n = len(udp.read(0.0))
        assert 0 < n < 100
        total_dropped = count_of(udp.counts, 'kernel')
        assert total_dropped == total * (100 - n) // 100
        udp.close()
        udp.open()


def test_long_and_empty_datagrams_are_counted(listen, sender):
    udp = listen(max_length=100)
    sender(udp, b'x' * 101, b'y' * 100, b'', b'z' * 5000, b'a')
    assert [c.data for c in udp.read(1.0)] == [b'y' * 100, b'a']
    assert_counts(udp.counts, {'max_length': 2, 'empty': 1})


def test_only_datagrams_of_the_configured_sources_are_read(listen, sender):
    udp = listen(sources=('127.0.0.9', '127.0.0.8'))
    sender(udp, b'foreign', b'foreign too')
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as known:
        known.bind(('127.0.0.8', 0))
        known.sendto(b'known', ('127.0.0.1', udp.settings.port))
        chunks = udp.read(1.0)
    assert [(c.data, c.source) for c in chunks] == [(b'known', '127.0.0.8')]
    assert_counts(udp.counts, {'other sources': 2})


def multicast(port, group, data):
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as opened:
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF,
                          socket.inet_aton('127.0.0.1'))
        opened.sendto(data, (group, port))


def test_a_multicast_socket_receives_only_its_group(listen, sender):
    first = listen(group='239.77.1.2')
    port = first.settings.port
    second = listen(group='239.77.1.2', port=port)
    other = listen(group='239.77.1.3', port=port)
    for group in ('239.77.1.2', '239.77.1.3'):
        multicast(port, group, group.encode())
    sender(first, b'not to the group')
    for udp, data in ((first, b'239.77.1.2'), (second, b'239.77.1.2'), (other, b'239.77.1.3')):
        assert [(c.data, c.source) for c in udp.read(1.0)] == [(data, '127.0.0.1')]
        assert udp.read(0.05) == []


def test_address_0_0_0_0_receives_at_all_addresses(listen, sender):
    udp = listen(address='0.0.0.0')
    sender(udp, b'x')
    sender(udp, b'y', to='127.0.0.5')
    assert [c.data for c in udp.read(1.0)] == [b'x', b'y']


def test_a_port_in_use_is_reported(listen):
    udp = listen()
    other = UdpSocket(udp.settings)
    assert f'127.0.0.1:{udp.settings.port}: the port' in open_error(other)
    udp.close()
    other.open()
    other.close()


@pytest.mark.parametrize('changes, text', [
    ({'address': '192.0.2.1'}, 'UDP 192.0.2.1:{port}: no interface'),
    ({'address': '192.0.2.1', 'group': '239.1.2.3'}, 'group 239.1.2.3: no interface'),
    ({'group': '192.0.2.9'}, '192.0.2.9 is'),
    ({'group': '127.0.0.1'}, '127.0.0.1 is')])
def test_an_unusable_address_is_reported(changes, text):
    port = free_port(socket.SOCK_DGRAM)
    udp = UdpSocket(replace(SETTINGS, port=port, **changes))
    before = len(os.listdir('/proc/self/fd'))
    assert text.format(port=port) in open_error(udp)
    assert len(os.listdir('/proc/self/fd')) == before
    with pytest.raises(DeviceError, match='not open'):
        udp.read(0.0)


def test_a_reserved_port_is_reported(monkeypatch):
    """The refusal is simulated because root may bind the port."""
    def bind(*_):
        raise PermissionError(13, 'Permission denied')

    monkeypatch.setattr(udp_socket.socket, 'socket', type('Socket', (socket.socket,),
                                                          {'bind': bind}))
    assert 'ports below 1024 are reserved' in open_error(UdpSocket(replace(SETTINGS, port=514)))


def test_a_limited_receive_buffer_is_reported(sockets, listen):
    reports = []
    udp = listen(reports.append, receive_buffer=1 << 30)
    actual_size = sockets[-1].getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    (report,) = reports
    assert all(part in report for part in (
        f':{udp.settings.port}: ', f' {actual_size} bytes', f' {1 << 30}', 'net.core.rmem_max'))
    reports.clear()
    listen(reports.append, receive_buffer=100_000)
    assert sockets[-1].getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 200_000
    assert not reports


def test_a_failing_socket_is_reported(sockets, listen):
    udp = listen()
    sockets[-1].close()
    with pytest.raises(DeviceError, match='UDP 127.0.0.1'):
        udp.read(1.0)


def test_close_ends_a_waiting_read_and_may_be_repeated(sockets):
    udp = UdpSocket(replace(SETTINGS, port=free_port(socket.SOCK_DGRAM)))
    udp.close()
    with pytest.raises(DeviceError, match=f'UDP 127.0.0.1:{udp.settings.port}: not open'):
        udp.read(0.0)
    before = len(os.listdir('/proc/self/fd'))
    for _ in range(2):
        udp.open()
        udp.open()
        closer = threading.Timer(0.1, udp.close)
        closer.start()
        start = time.monotonic()
        assert udp.read(20.0) == []
        assert 0.05 < time.monotonic() - start < 20.0
        closer.join()
        assert [s.fileno() for s in sockets] == [-1] * len(sockets)
        udp.close()
        udp.close()
        with pytest.raises(DeviceError, match='not open'):
            udp.read(0.0)
    assert len(os.listdir('/proc/self/fd')) == before


@pytest.mark.parametrize('changes, text', [
    ({}, 'port: '), ({'port': 5000, 'address': 'localhost'}, 'address: .*localhost'),
    ({'port': 5000, 'address': '::1'}, 'address: '), ({'port': 5000, 'group': 'x'}, 'group: '),
    ({'port': 5000, 'sources': ('127.0.0.1', '1.2.3')}, 'sources: expected an IPv4 .*1.2.3')])
def test_invalid_settings_are_refused(changes, text):
    with pytest.raises(SettingsError, match=text):
        UdpSocket(replace(SETTINGS, **changes))
