"""Adafruit's CircuitPython drivers with simulated chips, and custom drivers."""

import importlib.util
import sys
import time
from types import ModuleType

import numpy as np
import pytest

from mag_tracking.drivers.chips.circuitpython import UNITS
from mag_tracking.drivers.transports.i2c import I2cDevice, I2cSettings
from mag_tracking.errors import DeviceError
from mag_tracking.settings import replace
from support.circuitpython_chips import CASES, FakeMlx90393
from support.i2c_bus import B, FakeBus, FakeMultiplexer, rig
from support.i2c_chips import Clock, FakeLis3mdl, FakeMmc5603, FakeMmc5983ma

MMC5603 = 'adafruit_mmc56x3.MMC5603'


@pytest.fixture
def clock(monkeypatch):
    """Simulated clock, which also replaces the clock and the sleep of all drivers."""
    clock = Clock()
    monkeypatch.setattr(time, 'sleep', clock.sleep)
    monkeypatch.setattr(time, 'monotonic', lambda: clock.ns * 1e-9)
    for name in UNITS:
        # Some drivers import the function.
        module = name.rpartition('.')[0]
        if importlib.util.find_spec(module.partition('.')[0]) and hasattr(
                importlib.import_module(module), 'sleep'):
            monkeypatch.setattr(f'{module}.sleep', clock.sleep)
    return clock


def open_device(clock, chip, chips, address, **changes):
    """Open a device with the single sensor A; return (bus, device)."""
    pytest.importorskip(chip.rpartition('.')[0])
    _, bus, device = rig([f'A:{chip}:{address:#04x}'], chips, clock, **changes)
    device.open()
    return bus, device


@pytest.mark.parametrize('field', [B, (-1.3e-4, 1.1e-4, -1.2e-5)])
@pytest.mark.parametrize('case', CASES, ids=lambda case: case.name)
def test_drivers_as_users_install_them_read_the_field_in_tesla(clock, case, field):
    _, device = open_device(clock, case.name, case.chips(clock, field), case.address)
    for _ in range(3):
        (arrival,) = device.read(1.0)
        np.testing.assert_allclose(arrival.reading.field, np.multiply(field, case.scale),
                                   rtol=1e-6, atol=0.51 * case.count)
    assert all('missed' in name for name in device.counts)


def test_every_class_with_a_known_unit_is_tested():
    assert {case.name for case in CASES} == set(UNITS)


@pytest.mark.parametrize('case', [c for c in CASES if c.address == 0x1E and not c.others],
                         ids=lambda case: case.name)
def test_a_class_with_a_fixed_address_refuses_any_other(clock, case):
    chips = {**case.chips(clock, B), 0x1C: FakeMmc5603(clock)}
    with pytest.raises(DeviceError, match='but 0x1e'):
        open_device(clock, case.name, chips, 0x1C)


def test_a_chip_that_disappears_during_the_set_up_is_an_error(clock):
    # This driver ignores OSError while it waits for the answer to a command.
    chip = FakeMlx90393(clock)
    write = chip.write

    def write_and_disappear(data):
        write(data)
        chip.answers = len(data) < 4

    chip.write = write_and_disappear
    with pytest.raises(DeviceError, match='timeout'):
        open_device(clock, 'adafruit_mlx90393.MLX90393', {0x0C: chip}, 0x0C)


def test_the_unit_of_an_entry_has_priority(clock):
    pytest.importorskip('adafruit_qmc5883p')
    entry = 'A:adafruit_qmc5883p.QMC5883P:0x2c:uT'
    (case,) = (c for c in CASES if c.name in entry)
    _, _, device = rig([entry], case.chips(clock, B), clock)
    device.open()
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, np.multiply(B, 1e-2), atol=1e-9)


def test_adafruit_drivers_work_behind_a_multiplexer(clock):
    pytest.importorskip('adafruit_mmc56x3')
    fakes = [FakeMmc5603(clock, (n * 1e-5, 0.0, 0.0)) for n in range(3)]
    _, _, device = rig([f'{n}:{MMC5603}:0x30@0x70.{n}' for n in range(3)],
                       {0x70: FakeMultiplexer(clock, {n: {0x30: f} for n, f in enumerate(fakes)})},
                       clock)
    device.open()
    for arrival in device.read(1.0):
        assert arrival.reading.field[0] == pytest.approx(1.024e-5 * int(arrival.reading.sensor),
                                                         abs=1e-8)


@pytest.mark.parametrize('case', CASES, ids=lambda case: case.name)
def test_wrong_and_missing_chips_are_errors_of_the_device(clock, case):
    wrong = {address: FakeMmc5983ma(clock) for address in case.chips(clock, B)}
    for chips in [{}] + [wrong] * case.identifies:
        with pytest.raises(DeviceError, match=fr'A \({case.name}, address {case.address:#04x}'):
            open_device(clock, case.name, chips, case.address)


def test_failed_readings_are_counted_and_repeated_failures_raise(clock):
    fake = FakeMmc5603(clock)
    _, device = open_device(clock, MMC5603, {0x30: fake}, 0x30, max_failures=3)
    fake.answers = False
    assert device.read(0.01) == [] and device.counts['failed readings: A'] == 1
    fake.answers = True
    assert device.read(1.0)
    fake.answers = False
    with pytest.raises(DeviceError, match='A .* 3 .*no answer'):
        device.read(1.0)


def test_a_driver_that_waits_forever_times_out(clock):
    fake = FakeMmc5603(clock)
    _, device = open_device(clock, MMC5603, {0x30: fake}, 0x30, max_failures=2)
    assert device.read(1.0)
    fake.finish = lambda: None
    start = clock.ns
    assert device.read(0.1) == []
    assert (clock.ns - start) * 1e-9 < 0.4
    with pytest.raises(DeviceError, match='timeout'):
        device.read(1.0)


def custom_device(name, cls, **changes):
    """Return (clock, bus, device) of a LIS3MDL whose driver is the class `name`.Sensor."""
    clock = Clock()
    settings = replace(I2cSettings(), {'sensors': [f'A:{name}.Sensor:0x1c:uT'], **changes})
    bus = FakeBus(clock, {0x1C: FakeLis3mdl(clock)})
    return clock, bus, I2cDevice(settings, bus.open_bus, clock.monotonic_ns, clock.sleep)


class FailingDriver:
    """Driver that raises `error` at each reading."""

    error = RuntimeError

    def __init__(self, i2c, address):
        self.i2c = i2c

    @property
    def magnetic(self):
        assert self.i2c.try_lock() and not self.i2c.try_lock()
        raise self.error('overflow')


@pytest.fixture
def module(monkeypatch):
    """Module that can be imported as `our_driver`."""
    module = ModuleType('our_driver')
    monkeypatch.setitem(sys.modules, 'our_driver', module)
    return module


@pytest.mark.parametrize('error', [RuntimeError, ValueError, TypeError])
def test_an_exception_in_a_driver_is_a_failure_and_releases_the_lock(module, error):
    module.Sensor = type('Sensor', (FailingDriver,), {'error': error})
    _, _, device = custom_device('our_driver', FailingDriver, max_failures=2)
    device.open()
    with pytest.raises(DeviceError, match='failed in 2 .*overflow'):
        device.read(1.0)


def test_the_arrival_time_is_the_middle_of_the_call(module):
    class Sensor:
        def __init__(self, i2c, address):
            pass

        @property
        def magnetic(self):
            clock.sleep(0.1)
            return 1.0, 2.0, 3.0

    module.Sensor = Sensor
    clock, _, device = custom_device('our_driver', Sensor)
    device.open()
    assert device.read(1.0)[0].arrival_ns == clock.ns - 50_000_000


def test_an_os_error_without_errno_is_reported(module):
    def sensor(i2c, address):
        raise OSError('no data')

    module.Sensor = sensor
    with pytest.raises(DeviceError, match='no data'):
        custom_device('our_driver', None)[2].open()


@pytest.mark.parametrize('waiting', ['lock', 'bus'])
def test_waiting_for_the_lock_or_the_bus_times_out(module, waiting):
    class Sensor:
        def __init__(self, i2c, address):
            self.i2c, self.address = i2c, address

        @property
        def magnetic(self):
            assert self.i2c.try_lock()
            for _ in range(200):
                clock.sleep(0.01)
                if waiting == 'bus':
                    self.i2c.writeto(self.address, b'')
                else:
                    assert not self.i2c.try_lock()
            raise AssertionError('the driver was not stopped')

    module.Sensor = Sensor
    clock, _, device = custom_device('our_driver', Sensor, max_failures=1)
    device.open()
    with pytest.raises(DeviceError, match='timeout'):
        device.read(0.01)
        device.read(0.01)


def test_slices_of_buffers_are_transferred(module):
    class Sensor:
        def __init__(self, i2c, address):
            self.i2c, self.address = i2c, address

        @property
        def magnetic(self):
            assert self.i2c.try_lock()
            first_buffer = bytearray(b'....')
            self.i2c.writeto(self.address, b'_\x23\x0c_', start=1, end=3)
            self.i2c.writeto(self.address, b'_\x0f', start=1)
            self.i2c.readfrom_into(self.address, first_buffer, start=1, end=2)
            second_buffer = bytearray(b'....')
            self.i2c.writeto_then_readfrom(self.address, b'__\x23__', second_buffer,
                                           out_start=2, out_end=3, in_start=2, in_end=3)
            assert (bytes(first_buffer), bytes(second_buffer)) == (b'.\x3d..', b'..\x0c.')
            self.i2c.unlock()
            assert self.i2c.try_lock()
            return 1.0, -2.0, 3.0

    module.Sensor = Sensor
    _, _, device = custom_device('our_driver', Sensor)
    device.open()
    assert device.read(1.0)[0].reading.field == pytest.approx((1e-6, -2e-6, 3e-6))


def test_the_error_of_a_missing_driver_names_its_package():
    _, bus, device = rig(['A:adafruit_no_such.Sensor:0x1c:uT'], {})
    with pytest.raises(DeviceError, match='is adafruit-circuitpython-no_such installed'):
        device.open()
    assert not bus.open


def test_a_module_without_the_class_is_refused(module):
    _, _, device = custom_device('our_driver', None)
    with pytest.raises(DeviceError, match='our_driver .*Sensor'):
        device.open()


def test_a_board_unknown_to_blinka_is_reported(tmp_path, monkeypatch):
    (tmp_path / 'unknown_board.py').write_text('raise NotImplementedError("Board not supported")')
    monkeypatch.syspath_prepend(tmp_path)
    _, _, device = custom_device('unknown_board', None)
    with pytest.raises(DeviceError, match='Board not'):
        device.open()
