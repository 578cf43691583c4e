"""I2C magnetometers over a simulated bus: scales, axes, times, faults."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from mag_tracking.errors import DeviceError
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
"""(chip, settings, largest field [T], one count [T])."""


def test_a_range_is_a_range_of_the_table():
    assert {chip for chip, *_ in SCALES} == set(FAKES)


@hypothesis_settings(derandomize=True, deadline=None, max_examples=150)
@given(st.sampled_from(SCALES), st.tuples(*[st.floats(-1.0, 1.0)] * 3),
       st.tuples(*[st.integers(-3000, 3000)] * 3))
def test_the_field_comes_out_to_half_a_count(scale, part, bridge_offset):
    chip, changes, largest, count = scale
    _, bus, device, fake = one(chip, **{chip: changes})
    largest -= 3000.0 * count if hasattr(fake, 'bridge_offset') else count
    fake.bridge_offset = bridge_offset
    field = tuple(p * largest for p in part)
    fake.field = lambda ns: field
    (arrival,) = device.read(1.0)
    assert arrival.reading.sensor == 'A' and arrival.reading.acceleration is None
    np.testing.assert_allclose(arrival.reading.field, field, rtol=1e-12, atol=0.5001 * count)


@pytest.mark.parametrize('chip, changes, largest, count', SCALES)
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_full_scale_is_reached_and_beyond_is_nan(chip, changes, largest, count, sign):
    _, _, device, fake = one(chip, **{chip: changes})
    fake.field = lambda ns: (B[0], sign * (largest - 2 * count), B[2])
    field = device.read(1.0)[0].reading.field
    assert field[1] == pytest.approx(sign * largest, abs=3 * count)
    # The HMC's counts end at 2047, well above the range that is recommended.
    beyond = 2049 * count if chip.startswith('hmc') else 1.05 * largest
    fake.field = lambda ns: (B[0], B[1], sign * beyond)
    field = device.read(1.0)[0].reading.field
    assert np.isnan(field).tolist() == [False, False, True]
    np.testing.assert_allclose(field[:2], B[:2], atol=count)


@pytest.mark.parametrize('chip', FAKES)
def test_a_reading_has_the_time_of_its_conversion(chip):
    """The field changes by 1 mT/s, so it tells the time."""
    clock, _, device, fake = one(chip, rate_hz=23.0)
    errors = []
    for _ in range(40):
        start = clock.ns
        fake.field = lambda ns, start=start: ((ns - start - 50e6) * 1e-12, 0.0, 0.0)
        (arrival,) = device.read(1.0)
        errors.append((arrival.arrival_ns - start - 50e6) * 1e-9
                      - arrival.reading.field[0] * 1e3)
    # What starts its conversions itself is late by what a command takes, and half a count.
    bound = {'rm3100': 0.5 / 147.0 + 3e-4, 'lis3mdl': 0.5 / 155.0 + 3e-4}.get(chip, 1.5e-4)
    assert np.abs(errors).max() < bound
    if chip in ('rm3100', 'lis3mdl'):
        assert abs(np.mean(errors)) < 1e-3


def read_for(device, clock, seconds):
    """All arrivals of some time."""
    end_ns, out = clock.ns + round(seconds * 1e9), []
    while clock.ns < end_ns:
        out += device.read((end_ns - clock.ns) * 1e-9)
    return out


@pytest.mark.parametrize('rate', [0.5, 7.0, 50.0, 80.0])
def test_turns_keep_their_rate_whatever_they_take(rate):
    clock, _, device, _ = one('mmc5983ma', rate_hz=rate)
    device.read(3.0)
    arrivals = read_for(device, clock, 200.0 / rate)
    times = np.array([a.arrival_ns for a in arrivals]) * 1e-9
    assert abs(len(times) - 200) <= 1
    np.testing.assert_allclose(np.diff(times), 1.0 / rate, atol=1e-6)
    assert not device.counts


def test_turns_that_were_missed_are_counted_and_the_grid_stays():
    clock, _, device, _ = one('hmc5883l', rate_hz=50.0)
    before = device.read(1.0)[0].arrival_ns
    clock.sleep(0.110)
    after = device.read(1.0)[0].arrival_ns
    again = device.read(1.0)[0].arrival_ns
    # 20, 40, 60, 80 ms are gone; 100 ms is late, and the next one is not.
    assert device.counts == {'polling cycles missed': 4}
    assert (again - before) * 1e-9 == pytest.approx(0.120, abs=5e-3)
    assert (after - before) * 1e-9 == pytest.approx(0.110, abs=1e-2)
    clock.sleep(0.03)
    device.read(1.0)
    assert device.counts == {'polling cycles missed': 5}


def test_a_turn_that_takes_longer_than_the_period_misses_others():
    clock, _, device, _ = one('mmc5983ma', rate_hz=100.0, mmc5983ma={'conversion_ms': 8.0})
    arrivals = read_for(device, clock, 2.0)
    assert len(arrivals) + device.counts['polling cycles missed'] == pytest.approx(200, abs=3)
    assert 60 < len(arrivals) < 105


def test_nothing_due_is_nothing_read_after_the_timeout():
    clock, _, device, _ = one('hmc5883l', rate_hz=2.0)
    device.read(1.0)
    start = clock.ns
    assert device.read(0.3) == []
    assert (clock.ns - start) * 1e-9 == pytest.approx(0.3, abs=1e-6)
    assert device.read(0.0) == [] and clock.ns - start < 301_000_000
    assert len(device.read(1.0)) == 1


def test_the_chips_of_a_bus_measure_at_the_same_time():
    entries = ['A:mmc5603:0x30', 'B:hmc5883l:0x1e', 'E:lis3mdl:0x1c', 'C:rm3100:0x20',
               'D:rm3100:0x21']
    clock, bus, device = rig(entries)
    device.open()
    start = clock.ns
    arrivals = device.read(1.0)
    assert sorted(a.reading.sensor for a in arrivals) == list('ABCDE')
    assert [a.arrival_ns for a in arrivals] == sorted(a.arrival_ns for a in arrivals)
    # One after the other they would take twice as long.
    assert (clock.ns - start) * 1e-9 < 0.0135
    assert max(a.arrival_ns for a in arrivals) - min(a.arrival_ns for a in arrivals) < 15e6


@pytest.mark.parametrize('chip', ['lis3mdl', 'rm3100'])
def test_no_conversion_is_read_twice(chip):
    clock, _, device, fake = one(chip, rate_hz=400.0)
    serial = itertools.count()
    fake.field = lambda ns: (next(serial) * 1e-7, 0.0, 0.0)
    arrivals = read_for(device, clock, 1.0)
    rate = {'lis3mdl': 155, 'rm3100': 147}[chip]
    assert len(arrivals) == pytest.approx(rate, abs=2)
    assert np.diff([a.reading.field[0] for a in arrivals]) == pytest.approx(1e-7, abs=2e-8)
    assert device.counts == {
        'polling cycles without a new conversion: A': pytest.approx(400 - rate, abs=3)}


def test_conversions_that_nobody_read_are_counted():
    clock, _, device = rig(['A:lis3mdl:0x1c', 'B:lis3mdl:0x1e'], rate_hz=50.0)
    device.open()
    assert len(read_for(device, clock, 0.985)) == 100
    # B was set up first: the second is there already when it is first read.
    assert device.counts == {'conversions overwritten before they were read: A': 50,
                             'conversions overwritten before they were read: B': 49}


@pytest.mark.parametrize('chip, changes', [
    ('mmc5983ma', {}), ('mmc5603', {}), ('mmc5603', {'set_reset_s': 10.0}), ('hmc5883l', {})])
def test_a_conversion_that_is_not_done_is_no_reading(chip, changes):
    _, _, device, fake = one(chip, **{chip: changes})
    slow = fake.CONVERSION_MS if hasattr(fake, 'CONVERSION_MS') else None
    device.read(1.0)
    if slow:
        fake.CONVERSION_MS = (12.0,) * 4
    else:
        fake.finish = lambda: None
    assert device.read(0.0199) == []
    device.read(0.0199)
    assert device.counts['polling cycles without a new conversion: A'] >= 1
    if slow:
        fake.CONVERSION_MS = slow
    else:
        del fake.finish
    assert np.isfinite(device.read(1.0)[0].reading.field).all()


@pytest.mark.parametrize('chip', ['mmc5983ma', 'mmc5603'])
def test_the_offset_of_the_bridge_is_measured_anew(chip):
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
    # What drifts meanwhile is in the field until then.
    assert between[0].reading.field[0] == pytest.approx(B[0] + 100 / 16384e4, abs=1e-8)


def test_an_axis_over_its_range_does_not_spoil_the_readings_after_it():
    clock, _, device, fake = one('mmc5983ma', mmc5983ma={'set_reset_s': 3600.0})
    fake.field = lambda ns: (9e-4, 0.0, 0.0)
    assert math.isnan(device.read(1.0)[0].reading.field[0])
    fake.field = lambda ns: B
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, B, atol=1e-8)
    device.read(1.0)
    assert len(fake.pulses) == 4


@pytest.mark.parametrize('chip', FAKES)
def test_a_failure_is_counted_and_tried_again(chip):
    clock, bus, device, fake = one(chip)
    device.read(1.0)
    for n in range(1, 13):
        fake.answers = False
        assert device.read(0.02) == []
        fake.answers = True
        assert len(device.read(1.0)) == 1
        assert device.counts['failed readings: A'] == n


@pytest.mark.parametrize('chip', FAKES)
def test_a_chip_that_goes_on_failing_is_lost_and_set_up_again(chip):
    clock, bus, device, fake = one(chip, max_failures=5)
    device.read(1.0)
    fake.answers = False
    with pytest.raises(DeviceError, match=r'A failed 5 times in a row: no answer'):
        device.read(10.0)
    with pytest.raises(DeviceError, match='A failed 5 times'):
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
    # It begins to count anew.
    assert device.read(0.001) == device.read(0.001) == []
    fake.answers = True
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, B, atol=1e-7)


def test_what_the_others_said_is_not_lost_with_a_chip():
    clock, bus, device = rig(['A:lis3mdl:0x1c', 'B:hmc5883l:0x1e'], max_failures=1)
    device.open()
    bus.chips[0x1C].answers = False
    assert [a.reading.sensor for a in device.read(1.0)] == ['B']
    with pytest.raises(DeviceError, match='A failed 1 times'):
        device.read(1.0)


@pytest.mark.parametrize('chip', ['rm3100', 'lis3mdl'])
def test_a_chip_whose_supply_was_cut_is_lost(chip):
    clock, _, device, fake = one(chip, silence_timeout_s=0.5)
    device.read(1.0)
    fake.power_up()
    start = clock.ns
    with pytest.raises(DeviceError, match='A: no new conversion in 25 polling cycles'):
        device.read(10.0)
    assert (clock.ns - start) * 1e-9 == pytest.approx(0.5, abs=0.03)
    device.open()
    fake.stop()
    assert device.read(0.001) == device.read(0.001) == []
    device.open()
    np.testing.assert_allclose(device.read(1.0)[0].reading.field, B, atol=1e-7)


def test_two_silent_turns_in_a_row_are_nothing():
    clock, _, device, fake = one('rm3100', rate_hz=10.0, silence_timeout_s=0.0)
    for silent in (2, 2):
        fake.stop()
        assert device.read(0.1 * silent - 0.05) == []
        fake.begin(6_800_000)
        assert device.read(1.0)


@pytest.mark.parametrize('chip', ['hmc5883l', 'hmc5983'])
def test_a_scale_that_went_with_the_supply_is_no_reading(chip):
    clock, _, device, fake = one(chip, **{chip: {'range_ut': 810.0}})
    device.read(1.0)
    fake.power_up()
    with pytest.raises(DeviceError, match='the chip lost its settings'):
        device.read(10.0)
    # The same gain, and yet not as it was set up.
    fake.memory[:] = bytes([0x70, 7 << 5]) + fake.memory[2:]
    device.open()
    fake.memory[0] = 0x70
    with pytest.raises(DeviceError, match='the chip lost its settings'):
        device.read(10.0)


def test_a_bus_that_hangs_costs_one_wait_a_turn():
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
    with pytest.raises(DeviceError, match='in a row: the bus hangs'):
        device.read(5.0)
