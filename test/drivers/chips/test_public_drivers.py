"""The project's chip drivers beside public ones, on the same simulated chips.

The ratios are those of the guide "Connect sensors", for the versions in constraints.txt.
"""

import numpy as np
import pytest

from mag_tracking.drivers.chips.chip import Bus, ChipLocation, Registers
from mag_tracking.drivers.chips.circuitpython import BusioI2c
from support.circuitpython_chips import loose_lis3mdl
from support.i2c_bus import FakeBus, rig
from support.i2c_chips import Clock, FakeHmc5883l, FakeMmc5603, FakeRm3100

FIELD = (21e-6, -3e-6, 44e-6)


@pytest.fixture
def clock(monkeypatch):
    """Simulated clock, which also replaces the sleep of all drivers."""
    clock = Clock()
    monkeypatch.setattr('time.sleep', clock.sleep)
    return clock


def busio(clock, chip, address):
    """Return an open bus with one chip as a public driver uses it."""
    bus = FakeBus(clock, {address: chip})
    bus.open_bus(1)
    i2c = BusioI2c(Registers(Bus(bus, clock.monotonic_ns, clock.sleep), ChipLocation(address)))
    i2c.begin(10**10)
    return i2c


def own_field(clock, name, chip, address, **changes):
    """Return the field of a chip by the project's driver [T]."""
    _, _, device = rig([f'A:{name}:{address:#04x}'], {address: chip}, clock, **changes)
    device.open()
    return np.array(device.read(1.0)[0].reading.field)


@pytest.mark.parametrize('range_ut, code', [(400.0, 0), (800.0, 1), (1200.0, 2), (1600.0, 3)])
def test_lis3mdl(clock, monkeypatch, range_ut, code):
    module = pytest.importorskip('adafruit_lis3mdl')
    monkeypatch.setattr(module, 'sleep', clock.sleep)
    chip = loose_lis3mdl(clock, FIELD)
    own = own_field(clock, 'lis3mdl', chip, 0x1C, lis3mdl={'range_ut': range_ut})
    sensor = module.LIS3MDL(busio(clock, chip, 0x1C))
    sensor.range = code
    clock.sleep(0.02)
    np.testing.assert_allclose(np.array(sensor.magnetic) * 1e-6, own, rtol=1e-9)


@pytest.mark.parametrize('offset', [0, 820])
def test_the_public_mmc5603_driver_is_2_percent_high_and_keeps_the_offset(clock, offset):
    module = pytest.importorskip('adafruit_mmc56x3')
    chip = FakeMmc5603(clock, FIELD)
    chip.bridge_offset = (offset,) * 3
    own = own_field(clock, 'mmc5603', chip, 0x30)
    np.testing.assert_allclose(own, FIELD, atol=4e-9)
    public = np.array(module.MMC5603(busio(clock, chip, 0x30)).magnetic) * 1e-6
    np.testing.assert_allclose(public, 1.024 * (own + offset / 16384e4), atol=1e-8)


@pytest.mark.parametrize('cycles, ratio', [(50, 1.0), (100, 0.95), (200, 0.9375)])
def test_the_public_rm3100_driver_is_low_except_at_50_cycles(clock, cycles, ratio):
    module = pytest.importorskip('rm3100')
    chip = FakeRm3100(clock, FIELD)
    own = own_field(clock, 'rm3100', chip, 0x20, rm3100={'cycle_count': cycles})
    np.testing.assert_allclose(own, FIELD, atol=3e-8)
    chip.power_up()
    public = np.array(module.RM3100_I2C(busio(clock, chip, 0x20), cycle_count=cycles).magnetic)
    np.testing.assert_allclose(public * 1e-6, ratio * own, atol=1e-9)


def test_an_lsm303dlhc_read_as_an_hmc5883l_is_wrong_by_its_gains(clock):
    class Lsm303dlhc(FakeHmc5883l):
        """The same registers; gain code 1 is 1100 counts per gauss on x and y, and 980 on z."""

        def finish(self):
            field = self.field
            self.field = lambda ns: np.multiply(field(ns), np.divide([1100, 1100, 980], 1090))
            super().finish()
            self.field = field

    own = own_field(clock, 'hmc5883l', Lsm303dlhc(clock, FIELD), 0x1E,
                    hmc5883l={'range_ut': 130.0})
    np.testing.assert_allclose(own / FIELD, [1.009, 1.009, 0.899], atol=0.02)
