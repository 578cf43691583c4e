"""Simulated device: fields, times, and the output of the command `listen`."""

import dataclasses
import io
import math
import re
import socket
import sys
import threading

import numpy as np
import pytest

from mag_tracking import cli
from mag_tracking.drivers.simulated_device import (
    MAX_BACKLOG_S,
    SimulatedDevice,
    SimulatorSettings,
)
from mag_tracking.errors import DeviceError, NetworkError, SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.simulation.scenario import Path, random_vehicle
from support.bundled import NETWORK_FILE

QUIET_SETTINGS = SimulatorSettings(network=str(NETWORK_FILE), rate_hz=50.0, noise=0.0,
                                   period_s=12.0, lead=30.0, offset=-1.0)


class Clock:
    """Clock that advances only in `sleep`, rounded up to whole nanoseconds."""

    def __init__(self):
        self.ns = 10**15

    def sleep(self, seconds):
        self.ns += math.ceil(seconds * 1e9)


def device_of(settings=QUIET_SETTINGS):
    """Return (simulated device, its clock)."""
    clock = Clock()
    return SimulatedDevice(settings, lambda: clock.ns, clock.sleep), clock


def first_arrivals(device, n, timeout_s=1.0):
    """Read the first `n` arrivals."""
    out = []
    while len(out) < n:
        out += device.read(timeout_s)
    return out[:n]


def true_field(network, t):
    """Field (n_sensors, 3) [T], world frame, `t` [s] after a pass with `QUIET_SETTINGS` begins.

    Both sensors are at x = 0. The path starts 30 m before them and takes 6 s at 10 m/s.
    """
    path = Path(np.array([-30.0, network.positions[:, 1].mean() - 1.0]), 0.0, 10.0)
    body = random_vehicle(np.random.default_rng(QUIET_SETTINGS.seed), length=QUIET_SETTINGS.length,
                          moment=QUIET_SETTINGS.moment)
    position, heading = path.at(np.array([t]))
    return network.earth_field + body.field(network.earth_field, position, heading,
                                            network.positions)[0]


def test_the_fields_are_those_of_a_passing_vehicle():
    device, _ = device_of()
    device.open()
    network = read_network(NETWORK_FILE)
    arrivals = first_arrivals(device, 2 * 350)
    for k in (0, 100, 150, 220, 299):
        B = true_field(network, k / 50.0)
        for j, name in enumerate(network.names):
            reading = arrivals[2 * k + j].reading
            assert (reading.sensor, reading.sequence, reading.ticks) == (name, k, 20_000 * k)
            np.testing.assert_allclose(reading.field, network.R_ws[j].T @ B[j], rtol=1e-9)
    # Then the road is empty until the next vehicle starts after 12 s.
    for j in range(2):
        np.testing.assert_allclose(arrivals[2 * 330 + j].reading.field,
                                   network.R_ws[j].T @ network.earth_field, rtol=1e-12)
    next_arrivals = first_arrivals(device, 2 * 400)
    assert next_arrivals[2 * 250].reading.sequence == 600
    np.testing.assert_array_equal(next_arrivals[2 * 250].reading.field, arrivals[0].reading.field)


def test_readings_arrive_in_time_with_the_specified_noise():
    device, clock = device_of(SimulatorSettings(network=str(NETWORK_FILE), noise=2e-8, lead=150.0,
                                                moment=0.0))
    device.open()
    begin, fields = clock.ns, []
    while clock.ns < begin + 20e9:
        for arrival in device.read(0.2):
            assert 0 <= arrival.arrival_ns - begin - 1000 * arrival.reading.ticks < 2e6
            fields.append(arrival.reading.field)
    assert len(fields) == pytest.approx(2 * 2000, abs=4)
    std = np.std(np.array(fields)[::2], axis=0)
    # The standard deviation of 2000 readings has a relative error of 1.6 %.
    np.testing.assert_allclose(std, 2e-8, rtol=0.08)


def test_sequential_sensors_measure_at_their_own_times():
    """Each sensor measures a fraction of the sampling interval after the previous sensor."""
    device, _ = device_of(dataclasses.replace(QUIET_SETTINGS, sequential=True))
    device.open()
    network = read_network(NETWORK_FILE)
    arrivals = first_arrivals(device, 2 * 250)
    for i in (0, 1, 300, 301, 499):
        k, j = divmod(i, 2)
        reading, t = arrivals[i].reading, k / 50.0 + j / 100.0
        assert (reading.sensor, reading.sequence) == (network.names[j], k)
        assert reading.ticks == round(1e6 * t)
        B = true_field(network, t)
        np.testing.assert_allclose(reading.field, network.R_ws[j].T @ B[j], rtol=1e-9)


def test_readings_not_read_in_time_are_dropped_and_counted():
    device, clock = device_of()
    device.open()
    first_arrivals(device, 2)
    clock.sleep(MAX_BACKLOG_S + 10.0)
    first = device.read(0.1)[0].reading
    lost = device.counts['readings dropped, not read in time']
    assert lost == 2 * (first.sequence - 1) == pytest.approx(2 * 500, abs=4)


def test_the_device_clock_continues_after_reopening():
    device, clock = device_of()
    with pytest.raises(DeviceError, match='not open'):
        device.read(0.1)
    device.open()
    first_arrivals(device, 2)
    device.close()
    clock.sleep(3.0)
    device.open()
    assert first_arrivals(device, 1)[0].reading.ticks >= 3_000_000


def test_unsuitable_settings_and_networks_are_refused(tmp_path):
    with pytest.raises(SettingsError, match='network: the path'):
        SimulatedDevice(SimulatorSettings())
    with pytest.raises(NetworkError):
        SimulatedDevice(SimulatorSettings(network=str(tmp_path / 'none.yaml')))
    path = tmp_path / 'no_earth.yaml'
    path.write_text('sensors: {a: {position: [0, 0, 0]}}')
    with pytest.raises(SettingsError, match='earth_field'):
        SimulatedDevice(SimulatorSettings(network=str(path)))
    with pytest.raises(SettingsError, match='length 0'):
        SimulatedDevice(SimulatorSettings(network=str(NETWORK_FILE), lead=0.0))


def drivers_file(tmp_path, sensors, unit='T'):
    """Write a drivers file for the simulator; return its path."""
    path = tmp_path / 'drivers.yaml'
    path.write_text(f'road:\n  device: simulator\n  simulator: {{network: {NETWORK_FILE}, '
                    f'moment: 0.0}}\n  sensors: {sensors}\n  unit: {unit}\n')
    return path


def test_listen_prints_rate_and_field_of_each_sensor(tmp_path, capsys):
    path = drivers_file(tmp_path, '{mag_1: mag_1, mag_2: mag_2}')
    assert cli.main(['listen', str(path), '--network', str(NETWORK_FILE), '--seconds', '2']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == 'road: open'
    [rate] = re.findall(r'mag_2 +([\d.]+) Hz +2.0\d\d +15.\d+ +-4[89].\d+ uT', lines[-1])
    assert 80.0 < float(rate) < 120.0
    assert 'unit' not in lines[-1]


@pytest.mark.parametrize('unit, remark', [('G', 'below 10 uT'), ('100.0', 'very large')])
def test_listen_names_a_field_of_implausible_strength(tmp_path, capsys, unit, remark):
    path = drivers_file(tmp_path, '{mag_1: mag_1, mag_2: mag_2}', unit)
    assert cli.main(['listen', str(path), '--seconds', '1']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.search(f'mag_1 .*{remark}.*check `unit`', lines[1])


def test_listen_reports_silent_sensors_and_invalid_arguments(tmp_path, capsys):
    path = drivers_file(tmp_path, '{mag_1: mag_1, north: mag_2}')
    assert cli.main(['listen', str(path), '--seconds', '1']) == 1
    output = capsys.readouterr().out
    assert 'sensors: mag_2' in output
    assert re.search(r'^  mag_2 +no readings$', output, re.M)
    assert cli.main(['listen', str(path), '--network', str(NETWORK_FILE), '--seconds', '0']) == 1
    assert '--seconds: ' in capsys.readouterr().err
    assert cli.main(['listen', str(tmp_path / 'none.yaml')]) == 1
    assert 'none.yaml' in capsys.readouterr().err


def test_listen_shows_a_rejected_line_and_writes_each_line_at_once(tmp_path, monkeypatch):
    path = tmp_path / 'drivers.yaml'
    path.write_text('board:\n  transport: udp\n  udp: {port: 5563}\n  framing: text\n'
                    '  text: {fields: [x, y, z]}\n  unit: uT\n  sensor: mag_1\n')
    # As redirected to a file, which Python writes in blocks.
    written = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(written))
    stop = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            while not stop.wait(0.05):
                udp.sendto(b'14,1;-11,2;49,0', ('127.0.0.1', 5563))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        assert cli.main(['listen', str(path), '--seconds', '1']) == 1
        print('a line')
        assert written.getvalue().endswith(b'a line\n')
    finally:
        stop.set()
        thread.join()
    assert b"'14,1;-11,2;49,0': set separator: ';'" in written.getvalue()
