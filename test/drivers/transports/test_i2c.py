"""I2C magnetometers over a simulated bus: scales, axes, times and failures."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from mag_tracking.errors import DeviceError
from support.counters import assert_counts, count_of
from support.i2c_bus import FAKES, B, one, rig

SCALES = [
    *(('mmc5983ma', {'conversion_ms': t}, 8e-4 - 7e-9, 1 / 16384e4) for t in (8.0, 4.0, 2.0, 0.5)),
    *(('mmc5603', {'conversion_ms': t}, 3e-3, 1 / 16384e4) for t in (6.6, 3.5, 2.0, 1.2)),
    *((chip, {'range_ut': r}, r * 1e-6, 1e-4 / gain) for chip in ('hmc5883l', 'hmc5983')
      for r, gain in [(88.0, 1370), (130.0, 1090), (190.0, 820), (250.0, 660), (400.0, 440),
                      (470.0, 390), (560.0, 330), (810.0, 230)]),
    *(('rm3100', {'cycle_count': n}, 8e-4, 1e-6 / gain) for n, gain in
      [(50, 20), (100, 38), (200, 75)]),
    *(('lis3mdl', {'range_ut': r}, r * 1e-6, 1e-4 / gain) for r, gain in
      [(400.0, 6842), (800.0, 3421), (1200.0, 2281), (1600.0, 1711)]),
]
"""(chip, settings, maximum field [T], one count [T])."""


def test_scales_are_tested_for_every_chip():
    assert {chip for chip, *_ in SCALES} == set(FAKES)


@hypothesis_settings(derandomize=True, deadline=None, max_examples=150)
@given(st.sampled_from(SCALES), st.tuples(*[st.floats(-1.0, 1.0)] * 3),
       st.tuples(*[st.integers(-3000, 3000)] * 3))
def test_the_field_is_accurate_to_half_a_count(scale, part, bridge_offset):
    chip, changes, largest, count = scale
    _, bus, device, fake = one(chip, **{chip: changes})
    largest -= 3001.0 * count if hasattr(fake, 'bridge_offset') else count
    fake.bridge_offset = bridge_offset
    field = tuple(p * largest for p in part)
    fake.field = lambda ns: field
    (arrival,) = device.read(1.0)
    assert arrival.reading.sensor == 'A' and arrival.reading.acceleration is None
    np.testing.assert_allclose(arrival.reading.field, field, rtol=1e-12, atol=0.5001 * count)


@pytest.mark.parametrize('chip, changes, largest, count', SCALES)
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_full_scale_is_measured_and_values_beyond_are_nan(chip, changes, largest, count, sign):
    _, _, device, fake = one(chip, **{chip: changes})
    fake.field = lambda ns: (B[0], sign * (largest - 2 * count), B[2])
    field = device.read(1.0)[0].reading.field
    assert field[1] == pytest.approx(sign * largest, abs=3 * count)
    # The HMC's counts end at 2047, well above the recommended range.
    beyond = 2049 * count if chip.startswith('hmc') else 1.05 * largest
    fake.field = lambda ns: (B[0], B[1], sign * beyond)
    field = device.read(1.0)[0].reading.field
    assert np.isnan(field).tolist() == [False, False, True]
    np.testing.assert_allclose(field[:2], B[:2], atol=count)


@pytest.mark.parametrize('chip', FAKES)
def test_the_arrival_time_is_that_of_the_conversion(chip):
    """The field encodes the time, because it changes by 1 mT/s."""
    clock, _, device, fake = one(chip, rate_hz=23.0)
    errors = []
    for _ in range(40):
        start = clock.ns
        fake.field = lambda ns, start=start: ((ns - start - 50e6) * 1e-12, 0.0, 0.0)
        (arrival,) = device.read(1.0)
        errors.append((arrival.arrival_ns - start - 50e6) * 1e-9
                      - arrival.reading.field[0] * 1e3)
    # A continuously converting chip is off by up to half a period plus the time of a command.
    bound = {'rm3100': 0.5 / 147.0 + 3e-4, 'lis3mdl': 0.5 / 155.0 + 3e-4}.get(chip, 1.5e-4)
    assert np.abs(errors).max() < bound
    if chip in ('rm3100', 'lis3mdl'):
        assert abs(np.mean(errors)) < 1e-3


def read_for(device, clock, seconds):
    """Read for `seconds`; return all arrivals."""
    end_ns, out = clock.ns + round(seconds * 1e9), []
    while clock.ns < end_ns:
        out += device.read((end_ns - clock.ns) * 1e-9)
    return out


@pytest.mark.parametrize('rate', [0.5, 7.0, 50.0, 80.0])
def test_polling_cycles_keep_their_rate(rate):
    clock, _, device, _ = one('mmc5983ma', rate_hz=rate)
    device.read(3.0)
    arrivals = read_for(device, clock, 200.0 / rate)
    times = np.array([a.arrival_ns for a in arrivals]) * 1e-9
    assert abs(len(times) - 200) <= 1
    np.testing.assert_allclose(np.diff(times), 1.0 / rate, atol=1e-6)
    assert not device.counts


def test_missed_polling_cycles_are_counted_and_the_grid_is_kept():
    clock, _, device, _ = one('hmc5883l', rate_hz=50.0)
    before = device.read(1.0)[0].arrival_ns
    clock.sleep(0.110)
    after = device.read(1.0)[0].arrival_ns
    again = device.read(1.0)[0].arrival_ns
    # The cycles at 20, 40, 60 and 80 ms are missed. The cycle at 100 ms is late, the next is not.
    assert_counts(device.counts, {'missed': 4})
    assert (again - before) * 1e-9 == pytest.approx(0.120, abs=5e-3)
    assert (after - before) * 1e-9 == pytest.approx(0.110, abs=1e-2)
    clock.sleep(0.03)
    device.read(1.0)
    assert_counts(device.counts, {'missed': 5})


def test_polling_cycles_longer_than_the_period_are_partly_missed():
    clock, _, device, _ = one('mmc5983ma', rate_hz=100.0, mmc5983ma={'conversion_ms': 8.0})
    arrivals = read_for(device, clock, 2.0)
    assert len(arrivals) + count_of(device.counts, 'missed') == pytest.approx(200, abs=3)
    assert 60 < len(arrivals) < 105


def test_read_without_a_due_cycle_returns_nothing_at_its_timeout():
    clock, _, device, _ = one('hmc5883l', rate_hz=2.0)
    device.read(1.0)
    start = clock.ns
    assert device.read(0.3) == []
    assert (clock.ns - start) * 1e-9 == pytest.approx(0.3, abs=1e-6)
    assert device.read(0.0) == [] and clock.ns - start < 301_000_000
    assert len(device.read(1.0)) == 1


def test_the_chips_on_a_bus_measure_simultaneously():
    entries = ['A:mmc5603:0x30', 'B:hmc5883l:0x1e', 'E:lis3mdl:0x1c', 'C:rm3100:0x20',
               'D:rm3100:0x21']
    clock, bus, device = rig(entries)
    device.open()
    start = clock.ns
    arrivals = device.read(1.0)
    assert sorted(a.reading.sensor for a in arrivals) == list('ABCDE')
    assert [a.arrival_ns for a in arrivals] == sorted(a.arrival_ns for a in arrivals)
    # Sequential conversions would take twice as long.
    assert (clock.ns - start) * 1e-9 < 0.0135
    assert max(a.arrival_ns for a in arrivals) - min(a.arrival_ns for a in arrivals) < 15e6


@pytest.mark.parametrize('chip', ['lis3mdl', 'rm3100'])
def test_no_conversion_is_read_twice(chip):
    clock, _, device, fake = one(chip, rate_hz=400.0)
    numbers = itertools.count()
    fake.field = lambda ns: (next(numbers) * 1e-7, 0.0, 0.0)
    arrivals = read_for(device, clock, 1.0)
    rate = {'lis3mdl': 155, 'rm3100': 147}[chip]
    assert len(arrivals) == pytest.approx(rate, abs=2)
    assert np.diff([a.reading.field[0] for a in arrivals]) == pytest.approx(1e-7, abs=2e-8)
    assert_counts(device.counts, {'new conversion: A': pytest.approx(400 - rate, abs=3)})


def test_overwritten_conversions_are_counted():
    clock, _, device = rig(['A:lis3mdl:0x1c', 'B:lis3mdl:0x1e'], rate_hz=50.0)
    device.open()
    assert len(read_for(device, clock, 0.985)) == 100
    # A is set up first: its first conversion is overwritten before the first reading.
    assert_counts(device.counts, {': A': 50, ': B': 49})


@pytest.mark.parametrize('chip, changes', [
    ('mmc5983ma', {}), ('mmc5603', {}), ('mmc5603', {'set_reset_s': 10.0}), ('hmc5883l', {})])
def test_an_unfinished_conversion_gives_no_reading(chip, changes):
    _, _, device, fake = one(chip, **{chip: changes})
    slow = fake.CONVERSION_MS if hasattr(fake, 'CONVERSION_MS') else None
    device.read(1.0)
    if slow:
        fake.CONVERSION_MS = (12.0,) * 4
    else:
        fake.finish = lambda: None
    assert device.read(0.0199) == []
    device.read(0.0199)
    assert count_of(device.counts, ': A') >= 1
    if slow:
        fake.CONVERSION_MS = slow
    else:
        del fake.finish
    assert np.isfinite(device.read(1.0)[0].reading.field).all()


@pytest.mark.parametrize('chip', ['mmc5983ma', 'mmc5603'])
def test_the_bridge_offset_is_measured_periodically(chip):
    clock, _, device, fake = one(chip, rate_hz=50.0, **{chip: {'set_reset_s': 1.0}})
    fake.bridge_offset = (20000.0, -7000.0, 300.0)
    arrivals = read_for(device, clock, 0.97)
    assert len(fake.pulses) == 2 and len(arrivals) == 49
    fake.bridge_offset = (20100.0, -7000.0, 300.0)
    between = read_for(device, clock, 0.02)
    after = read_for(device, clock, 1.0)
    assert len(fake.pulses) == 4
    for arrival in arrivals + after[1:]:
        np.testing.assert_allclose(arrival.reading.field, B, atol=0.76 / 16384e4)
    # Until the next pair, the drift of the offset remains in the field.
    assert between[0].reading.field[0] == pytest.approx(B[0] + 100 / 16384e4, abs=1e-8)


def test_an_overrange_axis_does_not_affect_later_readings():
    clock, _, device, fake = one('mmc5983ma', mmc5983ma={'set_reset_s': 3600.0})
    fake.field = lambda ns: (9e-4, 0.0, 0.0)
    assert math.isnan(device.read(1.0)[0].reading.field[0])
    fake.field = lambda ns: B
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, B, atol=1e-8)
    device.read(1.0)
    assert len(fake.pulses) == 4


@pytest.mark.parametrize('chip', FAKES)
def test_a_failed_reading_is_counted_and_retried(chip):
    clock, bus, device, fake = one(chip)
    device.read(1.0)
    for n in range(1, 13):
        fake.answers = False
        assert device.read(0.02) == []
        fake.answers = True
        assert len(device.read(1.0)) == 1
        assert device.counts['failed readings: A'] == n


@pytest.mark.parametrize('chip', FAKES)
def test_a_chip_that_keeps_failing_is_lost_and_can_be_reopened(chip):
    clock, bus, device, fake = one(chip, max_failures=5)
    device.read(1.0)
    fake.answers = False
    with pytest.raises(DeviceError, match='A .* 5 .*no answer'):
        device.read(10.0)
    with pytest.raises(DeviceError, match='A .* 5 '):
        device.read(10.0)
    assert device.counts['failed readings: A'] == 5
    device.close()
    assert not bus.open
    with pytest.raises(DeviceError, match='no answer'):
        device.open()
    assert not bus.open
    fake.answers = True
    fake.power_up()
    device.open()
    fake.answers = False
    # The count of consecutive failures restarts at zero.
    assert device.read(0.001) == device.read(0.001) == []
    fake.answers = True
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, B, atol=1e-7)


def test_readings_of_other_chips_are_returned_when_one_is_lost():
    clock, bus, device = rig(['A:lis3mdl:0x1c', 'B:hmc5883l:0x1e'], max_failures=1)
    device.open()
    bus.chips[0x1C].answers = False
    assert [a.reading.sensor for a in device.read(1.0)] == ['B']
    with pytest.raises(DeviceError, match='A .* 1 '):
        device.read(1.0)


@pytest.mark.parametrize('chip', ['rm3100', 'lis3mdl'])
def test_a_power_cut_is_detected_by_missing_conversions(chip):
    clock, _, device, fake = one(chip, silence_timeout_s=0.5)
    device.read(1.0)
    fake.power_up()
    start = clock.ns
    with pytest.raises(DeviceError, match='A: .* 25 polling'):
        device.read(10.0)
    assert (clock.ns - start) * 1e-9 == pytest.approx(0.5, abs=0.03)
    device.open()
    fake.stop()
    assert device.read(0.001) == device.read(0.001) == []
    device.open()
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, B, atol=1e-7)


def test_two_silent_polling_cycles_are_tolerated():
    clock, _, device, fake = one('rm3100', rate_hz=10.0, silence_timeout_s=0.0)
    for silent in (2, 2):
        fake.stop()
        assert device.read(0.1 * silent - 0.05) == []
        fake.begin(6_800_000)
        assert device.read(1.0)


@pytest.mark.parametrize('chip', ['hmc5883l', 'hmc5983'])
def test_a_chip_that_lost_its_settings_gives_no_reading(chip):
    clock, _, device, fake = one(chip, **{chip: {'range_ut': 810.0}})
    device.read(1.0)
    fake.power_up()
    with pytest.raises(DeviceError, match='lost its'):
        device.read(10.0)
    # The gain is unchanged, but another register has changed.
    fake.memory[:] = bytes([0x70, 7 << 5]) + fake.memory[2:]
    device.open()
    fake.memory[0] = 0x70
    with pytest.raises(DeviceError, match='lost its'):
        device.read(10.0)


def test_a_hanging_bus_costs_one_timeout_per_polling_cycle():
    clock, bus, device = rig(['A:lis3mdl:0x1c', 'B:hmc5883l:0x1e', 'C:rm3100:0x20'],
                             max_failures=2)
    device.open()
    device.read(1.0)
    bus.hangs = True
    start = clock.ns
    assert device.read(0.5) == []
    assert (clock.ns - start) * 1e-9 < 1.2
    assert {k: n for k, n in device.counts.items() if 'failed' in k} == {
        f'failed readings: {name}': 1 for name in 'ABC'}
    with pytest.raises(DeviceError, match='bus hangs'):
        device.read(5.0)
