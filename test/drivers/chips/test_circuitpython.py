"""The drivers of Adafruit themselves, over simulated chips."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from mag_tracking.drivers.transports.i2c import I2cDevice, I2cSettings
from mag_tracking.errors import DeviceError
from mag_tracking.settings import replace
from support.i2c_bus import B, FakeBus, FakeMultiplexer, rig
from support.i2c_chips import Clock, FakeLis3mdl, FakeMmc5603

LIS3MDL, MMC5603 = 'adafruit_lis3mdl.LIS3MDL', 'adafruit_mmc56x3.MMC5603'


@pytest.fixture
def clock(monkeypatch):
    """A clock by which the drivers wait, too."""
    clock = Clock()
    lis3mdl = pytest.importorskip('adafruit_lis3mdl')
    monkeypatch.setattr(lis3mdl, 'sleep', clock.sleep)
    mmc56x3 = pytest.importorskip('adafruit_mmc56x3')
    monkeypatch.setattr(mmc56x3, 'time', SimpleNamespace(sleep=clock.sleep))
    return clock


def opened(clock, chip, fake, **changes):
    """(bus, device) with the one sensor A."""
    address = 0x1C if chip == LIS3MDL else 0x30
    _, bus, device = rig([f'A:{chip}:{address:#04x}'], {address: fake}, clock, **changes)
    device.open()
    return bus, device


@pytest.mark.parametrize('chip, fake, scale, count', [
    (LIS3MDL, FakeLis3mdl, 1.0, 1e-4 / 6842),
    # That driver takes 0.0625 mG for a count of 1 / 16384 G.
    (MMC5603, FakeMmc5603, 0.0625e-3 * 16384, 6.25e-9)])
@pytest.mark.parametrize('field', [B, (-3.1e-4, 2.2e-4, -1e-9)])
def test_adafruit_drivers_read_the_field(clock, chip, fake, scale, count, field):
    fake = fake(clock, field)
    # Theirs reads six registers without saying so.
    fake.strict = False
    _, device = opened(clock, chip, fake)
    for _ in range(3):
        (arrival,) = device.read(1.0)
        assert arrival.reading.sensor == 'A'
        np.testing.assert_allclose(arrival.reading.field, np.multiply(field, scale), rtol=1e-9,
                                   atol=0.51 * count)
    assert not device.counts


def test_adafruit_drivers_behind_a_multiplexer(clock):
    fakes = [FakeMmc5603(clock, (n * 1e-5, 0.0, 0.0)) for n in range(3)]
    _, _, device = rig([f'{n}:{MMC5603}:0x30@0x70.{n}' for n in range(3)],
                       {0x70: FakeMultiplexer(clock, {n: {0x30: f} for n, f in enumerate(fakes)})},
                       clock)
    device.open()
    for arrival in device.read(1.0):
        assert arrival.reading.field[0] == pytest.approx(1.024e-5 * int(arrival.reading.sensor),
                                                         abs=1e-8)


def test_wrong_and_missing_chips(clock):
    with pytest.raises(DeviceError, match=r'A \(adafruit_lis3mdl.LIS3MDL, address 0x1c\).*Failed'):
        opened(clock, LIS3MDL, FakeMmc5603(clock))
    silent = FakeLis3mdl(clock)
    silent.answers = False
    with pytest.raises(DeviceError, match='No I2C device at address: 0x1c'):
        opened(clock, LIS3MDL, silent)


def test_a_failure_is_counted_and_the_chip_lost_in_the_end(clock):
    fake = FakeMmc5603(clock)
    _, device = opened(clock, MMC5603, fake, max_failures=3)
    fake.answers = False
    assert device.read(0.01) == [] and device.counts['failed readings: A'] == 1
    fake.answers = True
    assert device.read(1.0)
    fake.answers = False
    with pytest.raises(DeviceError, match='A failed 3 times in a row: no answer'):
        device.read(1.0)


def test_a_driver_that_waits_for_ever_is_stopped(clock):
    fake = FakeMmc5603(clock)
    _, device = opened(clock, MMC5603, fake, max_failures=2)
    assert device.read(1.0)
    fake.finish = lambda: None
    start = clock.ns
    assert device.read(0.1) == []
    assert (clock.ns - start) * 1e-9 < 0.4
    with pytest.raises(DeviceError, match='timeout while the driver waited for its chip'):
        device.read(1.0)


def made(name, cls, **changes):
    """A device with a driver of our own, in a module of that name; its chip is a LIS3MDL."""
    clock = Clock()
    settings = replace(I2cSettings(), {'sensors': [f'A:{name}.Sensor:0x1c'], **changes})
    bus = FakeBus(clock, {0x1C: FakeLis3mdl(clock)})
    return clock, bus, I2cDevice(settings, bus.open_bus, clock.monotonic_ns, clock.sleep)


class Raises:
    """A driver that does not get a reading."""

    error = RuntimeError

    def __init__(self, i2c, address):
        self.i2c = i2c

    @property
    def magnetic(self):
        assert self.i2c.try_lock() and not self.i2c.try_lock()
        raise self.error('overflow')


@pytest.fixture
def module(monkeypatch):
    """A module that can be loaded as `our_driver`."""
    module = ModuleType('our_driver')
    monkeypatch.setitem(sys.modules, 'our_driver', module)
    return module


@pytest.mark.parametrize('error', [RuntimeError, ValueError, TypeError])
def test_what_a_driver_raises_is_a_failure_and_its_lock_is_undone(module, error):
    module.Sensor = type('Sensor', (Raises,), {'error': error})
    _, _, device = made('our_driver', Raises, max_failures=2)
    device.open()
    with pytest.raises(DeviceError, match='failed 2 times in a row: .*overflow'):
        device.read(1.0)


def test_the_time_is_the_middle_of_the_call(module):
    class Sensor:
        def __init__(self, i2c, address):
            pass

        @property
        def magnetic(self):
            clock.sleep(0.1)
            return 1.0, 2.0, 3.0

    module.Sensor = Sensor
    clock, _, device = made('our_driver', Sensor)
    device.open()
    assert device.read(1.0)[0].arrival_ns == clock.ns - 50_000_000


def test_an_error_of_a_driver_without_a_number(module):
    def sensor(i2c, address):
        raise OSError('no data')

    module.Sensor = sensor
    with pytest.raises(DeviceError, match='cannot be read: no data'):
        made('our_driver', None)[2].open()


@pytest.mark.parametrize('waiting', ['lock', 'bus'])
def test_neither_lock_nor_bus_can_be_waited_for_for_ever(module, waiting):
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
            raise AssertionError('it was not stopped')

    module.Sensor = Sensor
    clock, _, device = made('our_driver', Sensor, max_failures=1)
    device.open()
    with pytest.raises(DeviceError, match='timeout while the driver waited'):
        device.read(0.01)
        device.read(0.01)


def test_parts_of_buffers(module):
    class Sensor:
        def __init__(self, i2c, address):
            self.i2c, self.address = i2c, address

        @property
        def magnetic(self):
            assert self.i2c.try_lock()
            whole = bytearray(b'....')
            self.i2c.writeto(self.address, b'_\x23\x0c_', start=1, end=3)
            self.i2c.writeto(self.address, b'_\x0f', start=1)
            self.i2c.readfrom_into(self.address, whole, start=1, end=2)
            other = bytearray(b'....')
            self.i2c.writeto_then_readfrom(self.address, b'__\x23__', other, out_start=2,
                                           out_end=3, in_start=2, in_end=3)
            assert (bytes(whole), bytes(other)) == (b'.\x3d..', b'..\x0c.')
            self.i2c.unlock()
            assert self.i2c.try_lock()
            return 1.0, -2.0, 3.0

    module.Sensor = Sensor
    _, _, device = made('our_driver', Sensor)
    device.open()
    assert device.read(1.0)[0].reading.field == pytest.approx((1e-6, -2e-6, 3e-6))


def test_a_driver_that_is_not_installed():
    _, bus, device = rig(['A:adafruit_no_such.Sensor:0x1c'], {})
    with pytest.raises(DeviceError, match='is adafruit-circuitpython-no_such installed'):
        device.open()
    assert not bus.open


def test_a_module_without_the_class(module):
    _, _, device = made('our_driver', None)
    with pytest.raises(DeviceError, match='the module our_driver has no Sensor'):
        device.open()


def test_a_board_that_blinka_does_not_know(tmp_path, monkeypatch):
    (tmp_path / 'unknown_board.py').write_text('raise NotImplementedError("Board not supported")')
    monkeypatch.syspath_prepend(tmp_path)
    _, _, device = made('unknown_board', None)
    with pytest.raises(DeviceError, match='cannot be loaded .Board not supported'):
        device.open()
