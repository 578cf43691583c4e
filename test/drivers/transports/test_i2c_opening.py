"""I2C magnetometers: settings, opening, closing and multiplexers."""

import errno
import threading
import time

import numpy as np
import pytest

from mag_tracking.drivers.transports.i2c import I2cDevice, I2cSettings
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import replace
from support.i2c_bus import FAKES, B, FakeBus, FakeMultiplexer, one, rig
from support.i2c_chips import Clock, FakeHmc5883l, FakeLis3mdl, FakeMmc5603


@pytest.mark.parametrize('entries, message', [
    ([''], 'at least one'),
    (['lis3mdl:0x1c'], "got 'lis3mdl:0x1c'"),
    (['A:lis3mdl:28'], "got 'A:lis3mdl:28'"),
    (['A:lis3mdl:0x1c@0x70'], 'channel'),
    (['A:lis3mdl:0x1c@0x70.8'], 'channel'),
    (['A:lis3dml:0x1c'], 'chip lis3dml .*mmc5983ma'),
    (['A:lis3mdl:0x78'], 'A: address 0x78'),
    (['A:lis3mdl:0x07'], 'A: address 0x07'),
    (['A:lis3mdl:0x1c@0x6f.1'], 'A: multiplexer 0x6f'),
    (['A:lis3mdl:0x1c@0x78.1'], 'A: multiplexer 0x78'),
    (['A:my_driver.Sensor:0x1c'], 'A: .* A:my_driver.Sensor:0x1c:uT'),
    (['A:my_driver.Sensor:0x1c@0x70.1'], 'A:my_driver.Sensor:0x1c@0x70.1:uT'),
    (['A:my_driver.Sensor:0x1c:oersted'], "A: unit: 'oersted' is neither"),
    (['A:lis3mdl:0x1c:uT'], 'A: .*lis3mdl .*:uT'),
    (['A:lis3mdl:0x1c', 'A:lis3mdl:0x1e'], 'A appears'),
    (['A:lis3mdl:0x1c', 'B:rm3100:0x1c'], 'A and B .*0x1c$'),
    (['A:lis3mdl:0x1c@0x70.1', 'B:lis3mdl:0x1c'], 'A and B'),
    (['A:lis3mdl:0x1c', 'B:lis3mdl:0x1c@0x70.1'], 'A and B .*0x1c, .*channel 1 .*0x70'),
    (['A:lis3mdl:0x1c@0x70.1', 'B:lis3mdl:0x1c@0x70.1'], 'A and B'),
    (['A:lis3mdl:0x70', 'B:lis3mdl:0x1c@0x70.1'], 'A: address 0x70'),
])
def test_invalid_sensor_entries_are_refused(entries, message):
    with pytest.raises(SettingsError, match=message):
        I2cDevice(replace(I2cSettings(), {'sensors': entries}))


@pytest.mark.parametrize('changes, message', [
    ({'mmc5983ma': {'conversion_ms': 3.5}},
     r'mmc5983ma\.conversion_ms: .*8\.0, 4\.0, 2\.0, 0\.5, got 3\.5'),
    ({'mmc5603': {'conversion_ms': 4.0}}, r'mmc5603\.conversion_ms'),
    ({'hmc5883l': {'range_ut': 100.0}}, r'hmc5883l\.range_ut: .*88\.0, 130\.0'),
    ({'hmc5983': {'range_ut': 100.0}}, r'hmc5983\.range_ut'),
    ({'rm3100': {'cycle_count': 150}}, r'rm3100\.cycle_count: .*50, 100, 200'),
    ({'lis3mdl': {'range_ut': 500.0}}, r'lis3mdl\.range_ut'),
])
def test_chip_settings_are_checked_before_opening(changes, message):
    (chip,) = changes
    with pytest.raises(SettingsError, match=message):
        rig([f'A:{chip}:{FAKES[chip][1]:#04x}'], **changes)


@pytest.mark.parametrize('chip', FAKES)
def test_the_default_settings_of_each_chip_work(chip):
    _, _, device, _ = one(chip)
    assert len(device.read(0.0)) == 1 and not device.counts


@pytest.mark.parametrize('code, message', [
    (errno.ENOENT, '/dev/i2c-7: not found; enable I2C.*modprobe i2c-dev'),
    (errno.EACCES, '/dev/i2c-7: no permission; .*usermod -aG i2c'),
    (errno.EIO, '/dev/i2c-7: .*Input/output'),
])
def test_a_bus_that_cannot_be_opened_is_reported(code, message):
    def open_bus(number):
        assert number == 7
        raise OSError(code, {errno.EIO: 'Input/output error'}.get(code, ''))

    settings = replace(I2cSettings(), {'sensors': ['A:lis3mdl:0x1c'], 'bus': 7})
    with pytest.raises(DeviceError, match=message):
        I2cDevice(settings, open_bus).open()


def test_a_missing_bus_is_reported_by_the_real_smbus():
    settings = replace(I2cSettings(), {'sensors': ['A:lis3mdl:0x1c'], 'bus': 254})
    with pytest.raises(DeviceError, match='/dev/i2c-254: not found'):
        I2cDevice(settings).open()


LEFTOVERS = {'mmc5983ma': {0x0A: 0x1C, 0x0B: 0x0D}, 'mmc5603': {0x1C: 0x1C, 0x1D: 0x10},
             'hmc5883l': {0: 0x71, 1: 0xE0}, 'hmc5983': {0: 0x72},
             'rm3100': {5: 50, 7: 50, 9: 50, 11: 0x9F},
             'lis3mdl': {0x20: 0x60, 0x21: 0x60, 0x23: 0x02, 0x05: 7}}
"""{chip: {register: value left by another program}}."""


@pytest.mark.parametrize('chip', FAKES)
def test_a_chip_is_set_up_from_any_state(chip):
    address = FAKES[chip][1]
    _, bus, device = rig([f'A:{chip}:{address:#04x}'])
    fake = bus.chips[address]
    for register, value in LEFTOVERS[chip].items():
        fake.memory[register] = value
    if chip == 'rm3100':
        fake.begin(1_900_000)
    device.open()
    np.testing.assert_allclose(device.read(0.0)[0].reading.field, B, atol=1e-7)
    assert fake.memory[0x05] != 7
    if chip.startswith('hmc'):
        # Bit 7 enables the temperature compensation, which the HMC5883L lacks.
        assert fake.memory[0] >> 7 == (chip == 'hmc5983')


def test_a_missing_chip_is_reported():
    _, bus, device = rig(['A:lis3mdl:0x1e'], {})
    with pytest.raises(DeviceError, match='/dev/i2c-1: A .lis3mdl.*0x1e.*i2cdetect -y 1'):
        device.open()
    assert bus.opened == 1 and not bus.open


def test_another_chip_at_the_address_is_identified():
    clock = Clock()
    _, bus, device = rig(['A:lis3mdl:0x1e'], {0x1E: FakeHmc5883l(clock)}, clock)
    with pytest.raises(DeviceError, match='A .lis3mdl.*0x0f .*0x00 .*0x3d.*hmc5883l'):
        device.open()
    assert not bus.open
    assert bus.chips[0x1E].written == []


@pytest.mark.parametrize('chip, register', [
    ('mmc5983ma', 0x2F), ('mmc5603', 0x39), ('hmc5883l', 0x0A), ('hmc5883l', 0x0B),
    ('hmc5983', 0x0C), ('rm3100', 0x36), ('lis3mdl', 0x0F)])
def test_every_identity_register_is_checked(chip, register):
    address = FAKES[chip][1]
    _, bus, device = rig([f'A:{chip}:{address:#04x}'])
    fake = bus.chips[address]
    # A soft reset would restore the memory, so the read access is replaced.
    fake.fetch = lambda r: 0x5A if r == register else fake.memory[r]
    with pytest.raises(DeviceError, match=f'register {register:#04x} .*0x5a .*0x..$'):
        device.open()


@pytest.mark.parametrize('error, message', [
    (OSError(errno.ETIMEDOUT, 'Connection timed out'), 'bus hangs'),
    (OSError(errno.EBUSY, 'Device or resource busy'), 'kernel driver'),
    (OSError(errno.ENXIO, 'No such device or address'), 'no answer'),
    (OSError(errno.EIO, 'Input/output error'), 'Input/output error'),
])
@pytest.mark.parametrize('when', range(6))
def test_a_failure_during_set_up_is_reported_and_closes_the_bus(error, message, when):
    _, bus, device = rig(['A:lis3mdl:0x1c'])
    bus.next_errors = [None] * when + [error]
    with pytest.raises(DeviceError, match=message):
        device.open()
    assert not bus.open
    device.open()
    assert bus.open and bus.number == 1


def test_a_truncated_block_is_a_failed_reading():
    clock, bus, device, fake = one('lis3mdl')
    device.read(1.0)
    read_block = bus.read_i2c_block_data
    bus.read_i2c_block_data = lambda *arguments: read_block(*arguments)[:5]
    assert device.read(0.02) == []
    assert device.counts['failed readings: A'] == 1


def test_close_and_open_may_be_repeated():
    _, bus, device, _ = one('lis3mdl')
    device.close()
    device.close()
    assert not bus.open
    with pytest.raises(DeviceError, match='/dev/i2c-1: not open'):
        device.read(0.1)
    device.open()
    assert device.read(1.0)
    device.open()
    assert (bus.opened, bus.closed) == (3, 2)
    rig(['A:lis3mdl:0x1c'])[2].close()


def test_close_ends_a_read_in_another_thread():
    class RealClock:
        ns = property(lambda self: time.monotonic_ns(), lambda self, ns: None)

    clock = RealClock()
    bus = FakeBus(clock, {0x1E: FakeHmc5883l(clock)})
    settings = replace(I2cSettings(), {'sensors': ['A:hmc5883l:0x1e'], 'rate_hz': 0.01})
    device = I2cDevice(settings, bus.open_bus)
    device.open()
    assert len(device.read(1.0)) == 1
    results = []
    thread = threading.Thread(target=lambda: results.append(device.read(30.0)))
    thread.start()
    time.sleep(0.15)
    start = time.monotonic()
    device.close()
    thread.join()
    assert results == [[]] and time.monotonic() - start < 1.0 and not bus.open


def multiplexed_rig():
    """(clock, bus, device): three chips on channels share an address; two are on the bus itself."""
    clock = Clock()
    fakes = {name: FakeLis3mdl(clock, (i * 1e-5, 0.0, 0.0))
             for i, name in enumerate('ABC', start=1)}
    chips = {0x70: FakeMultiplexer(clock, {0: {0x1C: fakes['A']}, 5: {0x1C: fakes['B']}}),
             0x71: FakeMultiplexer(clock, {0: {0x1C: fakes['C']}}),
             0x1E: FakeHmc5883l(clock), 0x30: FakeMmc5603(clock)}
    return rig(['A:lis3mdl:0x1c@0x70.0', 'B:lis3mdl:0x1c@0x70.5', 'D:hmc5883l:0x1e',
                'C:lis3mdl:0x1c@0x71.0', 'E:mmc5603:0x30'], chips, clock)


def test_only_one_channel_is_open_at_a_time():
    """The simulated bus also fails if two chips answer at the same address."""
    clock, bus, device = multiplexed_rig()
    device.open()
    for _ in range(5):
        fields = {a.reading.sensor: a.reading.field for a in device.read(1.0)}
        for i, name in enumerate('ABC', start=1):
            np.testing.assert_allclose(fields[name], (i * 1e-5, 0.0, 0.0), atol=1e-8)
        np.testing.assert_allclose(fields['D'], B, atol=1e-7)
    assert not [cause for cause in device.counts if 'failed' in cause]


def test_chips_on_different_channels_measure_simultaneously():
    clock = Clock()
    fields = {n: (n * 1e-5, 0.0, -1e-5) for n in range(4)}
    chips = {0x70: FakeMultiplexer(clock, {
        n: {0x1E: FakeHmc5883l(clock, fields[n])} for n in fields})}
    _, _, device = rig([f'{n}:hmc5883l:0x1e@0x70.{n}' for n in fields], chips, clock)
    device.open()
    start = clock.ns
    arrivals = device.read(1.0)
    assert (clock.ns - start) * 1e-9 < 0.010
    for arrival in arrivals:
        np.testing.assert_allclose(arrival.reading.field, fields[int(arrival.reading.sensor)],
                                   atol=1e-7)
    assert len(arrivals) == 4


def test_channels_are_closed_for_chips_on_the_bus_itself():
    _, bus, device = multiplexed_rig()
    device.open()
    # The last chip addressed is E, which is directly on the bus.
    assert bus.chips[0x70].mask == bus.chips[0x71].mask == 0
    assert set(bus.chips[0x70].written) == {0, 1, 1 << 5}
    assert set(bus.chips[0x71].written) == {0, 1}


def test_a_channel_stays_open_while_its_chip_is_addressed():
    clock = Clock()
    chips = {0x70: FakeMultiplexer(clock, {3: {0x1C: FakeLis3mdl(clock)}})}
    _, bus, device = rig(['A:lis3mdl:0x1c@0x70.3'], chips, clock)
    device.open()
    for _ in range(5):
        device.read(1.0)
    assert bus.chips[0x70].written == [1 << 3]


def test_channels_are_selected_again_after_a_multiplexer_reset():
    clock, bus, device = multiplexed_rig()
    device.open()
    device.read(1.0)
    for name in (0x70, 0x71):
        bus.chips[name].mask = 0
    # Any failure makes the driver select the channels again.
    bus.next_errors = [OSError(errno.EREMOTEIO, 'Remote I/O error')]
    device.read(1.0)
    assert len(device.read(1.0)) == 5


def test_a_channel_closed_by_another_program_is_opened_again():
    clock = Clock()
    chips = {0x70: FakeMultiplexer(clock, {3: {0x1C: FakeLis3mdl(clock)}})}
    _, bus, device = rig(['A:lis3mdl:0x1c@0x70.3'], chips, clock)
    device.open()
    assert device.read(1.0)
    bus.chips[0x70].mask = 0
    assert device.read(0.019) == []
    assert device.read(1.0)
    assert device.counts['failed readings: A'] == 1


def test_a_missing_multiplexer_is_reported():
    clock, bus, device = rig(['A:lis3mdl:0x1c@0x72.4'], {})
    with pytest.raises(DeviceError, match='channel 4 .*0x72.*no answer'):
        device.open()
