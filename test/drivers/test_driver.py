"""Driver: reopening, sensor names, units, timestamps, sequence numbers and counts."""

import gc
from collections import Counter

import numpy as np
import pytest

from mag_tracking.drivers.device_clock import ClockSettings
from mag_tracking.drivers.driver import Driver, serve
from mag_tracking.drivers.reading import Arrival, Chunk, DeviceDate, FramedDevice, Parsed, Reading
from mag_tracking.drivers.sensor_checks import MAX_REMEMBERED, SequenceCheck
from mag_tracking.drivers.settings import DriverSettings
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.records import AccelerationSample
from support.counters import assert_counts, count_of
from support.samples import MagSample, samples_of

WALL_OFFSET_NS = 1_700_000_000_000_000_000
CLOCK = ClockSettings(tick_s=1e-6, min_delay_s=0.0)


class SimulatedHost:
    """Simulated clocks of a host."""

    def __init__(self):
        self.now_ns, self.step_ns = 5_000_000_000, 0
        self.slept = []

    def monotonic_ns(self):
        return self.now_ns

    def wall_ns(self):
        return WALL_OFFSET_NS + self.step_ns + self.now_ns

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now_ns += round(seconds * 1e9)


class ScriptedDevice:
    """Device with a script of connection failures, read errors and lists of arrivals."""

    def __init__(self, machine, script):
        self.counts = Counter()
        self.calls = []
        self._machine, self._script = machine, list(script)

    def open(self):
        self.calls.append('open')
        if self._script and self._script[0] == 'no port':
            raise DeviceError(self._script.pop(0))

    def read(self, timeout_s):
        item = self._script.pop(0) if self._script else []
        if isinstance(item, Exception):
            raise item
        if not item:
            self._machine.sleep(timeout_s)
        return [Arrival(self._machine.now_ns, *a) if isinstance(a, tuple) and not isinstance(
            a, Reading) else Arrival(self._machine.now_ns, a) for a in item]

    def close(self):
        self.calls.append('close')


def poll_samples(driver, timeout_s):
    """Poll once; return the field samples and then the accelerations in one list."""
    readings, accelerations = driver.poll(timeout_s)
    return [*samples_of(readings), *accelerations]


def driver_of(script, settings=None, sensors=None, clock=CLOCK):
    machine = SimulatedHost()
    device = ScriptedDevice(machine, script)
    driver = Driver('board', device, DriverSettings(**(settings or {})), clock,
                    sensors or {'': 'mag_1'}, machine.monotonic_ns, machine.wall_ns, machine.sleep)
    return driver, device, machine


def test_a_reading_becomes_a_sample_in_si_units_and_wall_time():
    reading = Reading('A', (10.0, -20.0, float('nan')), (0.0, 0.0, 1.0), ticks=7)
    driver, _, machine = driver_of([[reading]], {'unit': 'mG', 'acceleration_unit': 'g'},
                                   {'A': 'mag_7'})
    field, acceleration = poll_samples(driver, 0.2)
    assert isinstance(field, MagSample) and isinstance(acceleration, AccelerationSample)
    assert field.sensor == acceleration.sensor == 'mag_7'
    np.testing.assert_allclose(field.field, [1e-6, -2e-6, np.nan])
    np.testing.assert_allclose(acceleration.acceleration, [0.0, 0.0, 9.80665])
    assert field.covariance is None
    assert field.stamp_ns == acceleration.stamp_ns == WALL_OFFSET_NS + machine.now_ns


@pytest.mark.parametrize('unit, tesla', [('T', 1.0), ('mT', 1e-3), ('uT', 1e-6), ('nT', 1e-9),
                                         ('G', 1e-4), ('mG', 1e-7), ('1.5e-8', 1.5e-8),
                                         ('µT', 1e-6), ('Gauss', 1e-4), ('1090/G', 1e-4 / 1090),
                                         ('6842 LSB/gauss', 1e-4 / 6842), ('0.15 uT', 1.5e-7)])
def test_units_are_converted_to_tesla(unit, tesla):
    driver, *_ = driver_of([[Reading('', (2.0, 3.0, 4.0))]], {'unit': unit})
    np.testing.assert_allclose(poll_samples(driver, 0.1)[0].field,
                               np.array([2.0, 3.0, 4.0]) * tesla, rtol=1e-12)


@pytest.mark.parametrize('settings, message', [
    ({'unit': 'furlong'}, "unit: 'furlong' is neither"), ({'unit': '1090'}, '1090/G'),
    ({'unit': '0'}, 'unit'), ({'unit': 'nan'}, 'unit'),
    ({'acceleration_unit': 'G'}, 'acceleration_unit'),
    ({'stamp_by': 'sundial'}, 'stamp_by: ')])
def test_invalid_settings_are_refused(settings, message):
    with pytest.raises(SettingsError, match=message):
        driver_of([], settings)


def test_a_lost_device_is_reopened_with_back_off():
    driver, device, machine = driver_of(
        ['no port'] * 6 + [[Reading('', (1.0, 2.0, 3.0))], DeviceError('pulled out'), 'no port',
                           [Reading('', (1.0, 2.0, 3.0))]])
    opened, times, samples = 0, [], []
    while len(samples) < 2:
        samples += poll_samples(driver, 0.01)
        if device.calls.count('open') > opened:
            opened = device.calls.count('open')
            times.append(machine.now_ns / 1e9)
            assert driver.is_open == (opened in (7, 9))
        if opened == 3:
            assert driver.fault == 'no port'
    waits = np.diff(times)
    # The interval doubles up to 1 s, and is reset by a reading.
    np.testing.assert_allclose(waits[:6], [0.1, 0.2, 0.4, 0.8, 1.0, 1.0], atol=0.011)
    np.testing.assert_allclose(waits[6:], [0.1, 0.2], atol=0.011)
    assert driver.fault == ''
    assert count_of(driver.counts(), 'open') == 7
    assert driver.counts()['connections lost'] == 1
    # A device that failed to open is also closed, because it may hold resources.
    assert device.calls.count('close') == 8
    assert max(machine.slept) <= 0.01 + 1e-9


def test_a_device_that_opens_but_fails_to_read_backs_off():
    driver, device, machine = driver_of([DeviceError('gone')] * 5)
    while machine.now_ns < 9e9:
        driver.poll(0.01)
    assert driver.counts()['connections lost'] == 5
    assert device.calls.count('open') == 6


def test_a_silent_device_is_reopened():
    driver, device, machine = driver_of([[Reading('', (1.0, 2.0, 3.0))]],
                                        {'silence_timeout_s': 3.0})
    begin = machine.now_ns
    while device.calls.count('open') < 2:
        driver.poll(0.2)
    assert 3.0 <= (machine.now_ns - begin) / 1e9 <= 3.6
    assert count_of(driver.counts(), 'silence') == 1
    patient, device, machine = driver_of([], {'silence_timeout_s': 0.0})
    for _ in range(1000):
        patient.poll(0.2)
    assert device.calls == ['open']


def test_steps_of_the_host_clock_shift_timestamps_and_are_counted():
    script = [[Reading('', (1.0, 2.0, 3.0), ticks=1000 * k)] for k in range(3)]
    driver, _, machine = driver_of(script)
    stamps = []
    for k in range(3):
        machine.now_ns = 5_000_000_000 + 1_000_000 * k
        machine.step_ns = 0 if k < 2 else 3_600_000_000_000
        stamps.append(poll_samples(driver, 0.1)[0].stamp_ns)
    assert stamps[1] - stamps[0] == pytest.approx(1_000_000, abs=2)
    assert stamps[2] - stamps[1] == pytest.approx(3_600_001_000_000, abs=2)
    assert count_of(driver.counts(), 'host clock') == 1


def test_stamp_by_selects_the_source_of_timestamps():
    def stamps(settings, readings, clock=CLOCK):
        driver, _, machine = driver_of([[r] for r in readings], settings, clock=clock)
        out = []
        for k in range(len(readings)):
            machine.now_ns = 5_000_000_000 + 10_000_000 * k + (3_000_000 if k == 1 else 0)
            out += [s.stamp_ns - WALL_OFFSET_NS - 5_000_000_000 for s in poll_samples(driver, 0.1)]
        return driver, out
    field = (1.0, 2.0, 3.0)
    with_ticks = [Reading('', field, ticks=10_000 * k, sequence=k) for k in range(3)]
    # The second reading arrives 3 ms late, which the clock of the device corrects.
    _, by_ticks = stamps({}, with_ticks)
    np.testing.assert_allclose(by_ticks, [0, 1e7, 2e7], atol=1e4)
    _, by_sequence = stamps({'stamp_by': 'sequence'}, with_ticks, ClockSettings(tick_s=0.01))
    np.testing.assert_allclose(by_sequence, [0, 1e7, 2e7], atol=1e4)
    _, by_arrival = stamps({'stamp_by': 'arrival'}, with_ticks)
    assert by_arrival == [0, 13_000_000, 20_000_000]
    _, auto = stamps({}, [Reading('', field)] * 3)
    assert auto == by_arrival
    driver, mixed = stamps({}, [with_ticks[0], Reading('', field), with_ticks[2]])
    assert len(mixed) == 2
    assert count_of(driver.counts(), 'device time') == 1


@pytest.mark.parametrize('ticks, clock', [
    (lambda k: DeviceDate(1.79e15 + 20_000 * k), ClockSettings(tick_s=1.0)),
    (lambda k: 1.79e12 + 20 * k, ClockSettings()), (lambda k: 1.79e18 + 2e7 * k, ClockSettings()),
    (lambda k: 1.79e9 + 0.005 + 0.02 * k, ClockSettings())])
def test_a_time_since_1970_needs_no_clock_settings(ticks, clock):
    """Messages are delayed by 0 to 50 ms; the timestamps follow the device."""
    readings = [Reading('', (1.0, 2.0, 3.0), ticks=ticks(k)) for k in range(100)]
    driver, _, machine = driver_of([[r] for r in readings], clock=clock)
    stamps = []
    for k in range(100):
        machine.now_ns = 10**10 + 20_000_000 * k + (k % 6) * 10_000_000
        stamps += [s.stamp_ns - WALL_OFFSET_NS for s in poll_samples(driver, 0.1)]
    expected = 10**10 + 20_000_000 * np.arange(100)
    assert np.abs(np.array(stamps) - expected)[50:].max() < 100_000
    assert not driver.examples()


def test_each_source_has_its_own_clock_and_name():
    here, there = Reading('', (1.0, 0.0, 0.0), ticks=0), Reading('', (2.0, 0.0, 0.0), ticks=10**9)
    driver, _, _ = driver_of([[(here, 'road/a'), (there, 'road/b'), (here, 'road/c')]],
                             sensors={'road/a': 'mag_1', 'road/b': 'mag_2'})
    samples = poll_samples(driver, 0.1)
    assert [(s.sensor, s.field[0]) for s in samples] == [('mag_1', 1.0), ('mag_2', 2.0)]
    assert samples[0].stamp_ns == samples[1].stamp_ns
    assert set(driver.clocks()) == {'road/a', 'road/b'}
    assert count_of(driver.counts(), 'road/c') == 1
    # A sensor name in the reading has precedence over the source.
    driver, _, _ = driver_of([[(Reading('A', (1.0, 0.0, 0.0)), 'road/b')]],
                             sensors={'A': 'mag_1', 'road/b': 'mag_2'})
    assert poll_samples(driver, 0.1)[0].sensor == 'mag_1'


def test_an_acceleration_alone_gives_no_field_sample():
    driver, *_ = driver_of([[Reading('', None, (0.0, 0.0, 9.8))]])
    assert [type(s) for s in poll_samples(driver, 0.1)] == [AccelerationSample]


def test_an_unexpected_error_of_a_device_is_a_fault():
    driver, device, machine = driver_of([])
    driver.poll(0.01)
    driver.fail(ZeroDivisionError('division by zero'))
    assert driver.fault.startswith('ZeroDivisionError: ') and not driver.is_open
    assert driver.counts()['errors'] == 1
    machine.now_ns += 200_000_000
    driver.poll(0.01)
    assert driver.is_open and device.calls == ['open', 'close', 'open']


def test_readings_are_batched():
    script = [[Reading('', (float(k), 0.0, 0.0))] for k in range(3)]
    driver, _, machine = driver_of([*script, []], {'batch_s': 0.004})
    assert [s.field[0] for s in poll_samples(driver, 0.2)] == [0.0, 1.0, 2.0]
    assert machine.slept == [pytest.approx(0.004)]
    # A lost connection does not discard the readings before it.
    driver, *_ = driver_of([script[0], DeviceError('gone'), DeviceError('gone')],
                           {'batch_s': 0.004})
    assert len(poll_samples(driver, 0.2)) == 1 and driver.is_open
    assert poll_samples(driver, 0.2) == [] and driver.fault == 'gone'


def check_sequence(numbers, wrap=0, values=None):
    check = SequenceCheck(wrap)
    new = [check.is_new(n, b'%d' % (k if values is None else values[k]))
           for k, n in enumerate(numbers)]
    return new, +check.counts


def test_losses_are_counted_by_sequence_number():
    assert check_sequence(range(5, 50)) == ([True] * 45, {})
    assert check_sequence([0, 1, 5, 6, 16]) == ([True] * 5, {'lost': 3 + 9})
    # A late reading was not lost, and is passed on.
    assert check_sequence([0, 1, 4, 2, 5]) == ([True] * 5, {'lost': 1, 'late arrivals': 1})
    assert check_sequence([254, 255, 0, 1], wrap=256) == ([True] * 4, {})
    assert check_sequence([250, 3, 255], wrap=256) == ([True] * 3, {'lost': 7, 'late arrivals': 1})
    assert_counts(check_sequence([0, 300, -1], wrap=256)[1], {'range': 2})
    assert check_sequence([0, 1000, 1001])[1] == {'lost': 999}
    # A corrupt number is not counted as a loss.
    assert check_sequence([0, 1, 2**64 - 1, 2, 3]) == (
        [True] * 5, {'sequence jumps': 1, 'sequence restarts': 1})


def test_duplicates_are_distinguished_from_restarts():
    # The same number with the same values is the same reading, NaN or not.
    assert check_sequence([0, 1, 1, 2, 0], values=[5, 6, 6, 7, 5]) == (
        [True, True, False, True, False], {'duplicates': 2})
    # If the values differ, the device has restarted, at a near or at a distant number.
    for begin in (3, 500, 100_000):
        assert check_sequence([begin, begin + 1, 0, 1, 2]) == (
            [True] * 5, {'sequence restarts': 1})


def test_the_memory_of_a_sequence_check_is_bounded():
    even = range(0, 100 * MAX_REMEMBERED, 2)

    def causes_of(number):
        return check_sequence([*even, number], values=[0] * (len(even) + 1))[1].keys() - {'lost'}

    # The bound applies to received and to missing numbers.
    last = even[-1]
    assert causes_of(last - 2 * (MAX_REMEMBERED - 1)) == {'duplicates'}
    assert causes_of(last - 2 * MAX_REMEMBERED) == {'sequence restarts'}
    assert causes_of(last - 1 - 2 * (MAX_REMEMBERED - 1)) == {'late arrivals'}
    assert causes_of(last - 1 - 2 * MAX_REMEMBERED) == {'sequence restarts'}


def test_duplicate_readings_are_dropped():
    """A reading with a repeated sequence number but other values is not a duplicate."""
    def reading(x, sequence, acceleration=None):
        return Reading('', (x, float('nan'), 3.0), acceleration, sequence=sequence)
    driver, *_ = driver_of([
        [reading(1.0, 1), reading(1.0, 1), reading(2.0, 2), reading(2.0, 2, (0.0, 0.0, 9.8))]])
    assert [type(s) for s in poll_samples(driver, 0.1)] == [MagSample] * 3 + [AccelerationSample]
    counts = driver.counts()
    assert (counts['duplicates: mag_1'], counts['sequence restarts: mag_1']) == (1, 1)


def test_stored_readings_are_not_tracked_by_the_garbage_collector():
    gc.collect()
    gc.disable()
    try:
        before = len(gc.get_objects())
        driver, *_ = driver_of([[Reading('', (float(k), 2.0, 3.0), (0.0, float(k), 9.8), sequence=k)
                                 for k in range(MAX_REMEMBERED)]])
        assert len(poll_samples(driver, 0.1)) == 2 * MAX_REMEMBERED
        assert len(gc.get_objects()) - before < MAX_REMEMBERED // 4
    finally:
        gc.enable()


@pytest.mark.parametrize('sequence', [None, 1])
@pytest.mark.parametrize('field', [(1.0, 2.0), (1.0, 2.0, 3.0) * 2, (10**400, 0.0, 0.0)])
def test_a_field_that_is_not_three_floats_is_an_error_of_the_device(field, sequence):
    """The components of invalid readings are not combined into valid fields."""
    driver, *_ = driver_of([[Reading('', field, sequence=sequence)] * 3])
    with pytest.raises(ValueError):
        driver.poll(0.1)


def test_an_infinite_field_is_dropped_but_its_acceleration_is_kept():
    driver, *_ = driver_of([[Reading('', (float('inf'), 0.0, 0.0), (0.0, 0.0, 9.8)),
                             Reading('', (1.0, 2.0, 3.0))]])
    field, acceleration = poll_samples(driver, 0.1)
    assert field.field.tolist() == [1.0, 2.0, 3.0] and isinstance(acceleration, AccelerationSample)
    assert count_of(driver.counts(), 'overflow') == 1


def test_a_single_sensor_accepts_only_its_first_name():
    driver, *_ = driver_of([[Reading('A', (1.0, 0.0, 0.0)), Reading('B', (2.0, 0.0, 0.0)),
                             Reading('A', (3.0, 0.0, 0.0))]])
    assert [s.field[0] for s in poll_samples(driver, 0.1)] == [1.0, 3.0]
    assert count_of(driver.counts(), ' B') == 1


def contested(sensors, *sources, seconds=30):
    """Poll a driver to which each of `sources`, as (rate [Hz], reading, source), sends; return
    (driver, simulated host, number of samples from each source).

    The next poll returns one more reading of the last source.
    """
    sent = sorted((k / rate + 1e-3 * i, i) for i, (rate, _, _) in enumerate(sources)
                  for k in range(round(seconds * rate)))
    # The field tells the sources apart.
    script = [[(reading if reading.field is None else reading._replace(field=(float(i), 0.0, 0.0)),
                source)] for _, i in sent for _, reading, source in [sources[i]]]
    driver, _, machine = driver_of([*script, script[-1]], sensors=sensors)
    start_ns, n = machine.now_ns, [0] * len(sources)
    for t, i in sent:
        machine.now_ns = max(machine.now_ns, start_ns + round(t * 1e9))
        for sample in poll_samples(driver, 0.0):
            n[i] += isinstance(sample, AccelerationSample) or sample.field[0] == i
    return driver, machine, n


FIELD = Reading('', (0.0, 0.0, 0.0))


@pytest.mark.parametrize('sensors, device, stray, named', [
    ({'': 'mag_1'}, (FIELD, '10.0.0.5'), (FIELD, '10.0.0.66'), ('10.0.0.5', '10.0.0.66')),
    # Topics of a broker, and one name of a sensor in the messages of two devices.
    ({'': 'mag_1'}, (FIELD, 'road/1/mag'), (FIELD, 'test/mag'), ('road/1/mag', 'test/mag')),
    ({'A': 'mag_1'}, (FIELD._replace(sensor='A'), 'road/1'), (FIELD._replace(sensor='A'), 'road/2'),
     ('A from road/1', 'A from road/2')),
    ({'': 'mag_1'}, (FIELD._replace(sensor='A'), ''), (FIELD._replace(sensor='B'), ''),
     ('A (', 'B ('))])
def test_two_sources_of_one_sensor_are_named_and_the_steadier_one_is_used(
        sensors, device, stray, named):
    driver, machine, (n_stray, n_device) = contested(sensors, (0.25, *stray), (20.0, *device))
    assert n_device >= 0.9 * 600 and n_stray <= 1
    assert all(name in driver.fault for name in named)
    assert driver.counts()['source changes'] == 1
    assert sum(driver.counts().values()) == 1 + 600 + 8
    # The fault ends when the second source is silent.
    machine.now_ns += 20_000_000_000
    assert len(poll_samples(driver, 0.0)) == 1 and driver.fault == ''


def test_a_sensor_weaker_than_the_earth_is_counted_once():
    # The field of the first source is 0.
    driver, *_ = contested({'': 'mag_1'}, (20.0, FIELD, ''), seconds=12)
    assert [n for cause, n in driver.counts().items() if 'unit: mag_1' in cause] == [1]
    driver, *_ = contested({'': 'mag_1'}, (20.0, FIELD, ''), seconds=4)
    assert driver.counts() == {'samples: mag_1': 80}


def test_a_field_and_an_acceleration_may_come_from_different_sources():
    driver, _, n = contested({'A': 'mag_1'}, (20.0, FIELD._replace(sensor='A'), 'a/mag'),
                             (20.0, Reading('A', None, (0.0, 0.0, 1.0)), 'a/acc'), seconds=5)
    assert n == [100, 100] and driver.fault == '' and set(driver.clocks()) == {'a/mag', 'a/acc'}


def test_thousands_of_sources_lock_no_sensor_out_and_keep_no_clocks():
    strays = [(0.125, Reading('A', (0.0, 0.0, 0.0), ticks=k), f'10.1.{k // 256}.{k % 256}')
              for k in range(5000)]
    driver, _, n = contested({'A': 'mag_1'}, (50.0, Reading('A', (0.0,) * 3), '10.0.0.5'), *strays,
                             seconds=8)
    assert n[0] >= 0.7 * 400 and len(driver.clocks()) <= 2
    assert '10.0.0.5' in driver.fault and len(driver.fault) < 400
    assert len(driver.counts()) < 40


def test_an_unused_sensor_is_ignored_without_a_count():
    driver, *_ = driver_of([[Reading('A', (1.0, 0.0, 0.0), sequence=1),
                             Reading('B', (2.0, 0.0, 0.0), sequence=1)]],
                           sensors={'A': 'mag_1', 'B': '-'})
    assert [s.sensor for s in poll_samples(driver, 0.1)] == ['mag_1']
    assert driver.counts() == {'samples: mag_1': 1}


def test_the_number_of_counted_unknown_names_is_bounded():
    readings = [Reading(f'x{k}', (1.0, 0.0, 0.0)) for k in range(1000)]
    driver, *_ = driver_of([readings, [readings[0], readings[-1]]], sensors={'A': 'mag_1'})
    assert poll_samples(driver, 0.1) == []
    assert len(driver.counts()) == 21
    assert count_of(driver.counts(), 'others)') == 980
    assert poll_samples(driver, 0.1) == []
    assert len(driver.counts()) == 21 and count_of(driver.counts(), ' x0') == 2
    assert count_of(driver.counts(), 'others)') == 981


def test_a_device_that_fails_to_close_is_reopened():
    driver, device, machine = driver_of([DeviceError('gone')])

    def close():
        raise OSError('stuck')
    device.close = close
    driver.poll(0.1)
    assert not driver.is_open and 'gone; ' in driver.fault and 'OSError: stuck' in driver.fault
    machine.now_ns += 10**9
    driver.poll(0.1)
    assert driver.is_open and count_of(driver.counts(), 'close') == 1
    # The fault remains until a reading arrives.
    assert driver.fault


def test_errors_in_processing_do_not_close_the_device():
    driver, device, _ = driver_of([[Reading('', (1.0, 2.0, 3.0))]] * 3)
    processed = []

    def process(readings, accelerations):
        assert not accelerations
        processed.append(readings)
        if len(processed) == 1:
            raise ValueError('unexpected value')
    serve(driver, process, lambda: len(processed) == 3)
    assert device.calls == ['open', 'close']
    assert count_of(driver.counts(), 'ValueError') == 1


class DigitFraming:
    """Framing of two-byte frames: a digit and a newline."""

    def parse(self, data, final=False):
        n = len(data) // 2 * 2
        readings = [Reading('', (float(data[i:i + 1]), 0.0, 0.0)) for i in range(0, n, 2)]
        rest = len(data) - n
        return Parsed(tuple(readings), len(data) if final else n,
                      {'bytes between frames': rest} if final and rest else {})


class ScriptedTransport:
    """Transport that returns predefined chunks."""

    def __init__(self, chunks, is_message_oriented=False):
        self.is_message_oriented = is_message_oriented
        self.counts, self._chunks = Counter(dropped=2), list(chunks)

    def open(self):
        pass

    def read(self, timeout_s):
        return [self._chunks.pop(0)] if self._chunks else []

    def close(self):
        pass


def test_frames_are_assembled_from_a_stream():
    device = FramedDevice(ScriptedTransport([
        Chunk(1, b'1\n2'), Chunk(2, b'\n3'), Chunk(3, b'4\n')]), DigitFraming())
    device.open()
    assert [(a.arrival_ns, a.reading.field[0]) for a in device.read(0.0)] == [(1, 1.0)]
    assert [(a.arrival_ns, a.reading.field[0]) for a in device.read(0.0)] == [(2, 2.0)]
    # The connection is lost within a frame. The start of this frame is not joined with later bytes.
    device.open()
    assert [a.reading.field[0] for a in device.read(0.0)] == [4.0]
    assert_counts(device.counts, {'dropped': 2, 'truncated': 1})


def test_messages_are_not_joined():
    device = FramedDevice(ScriptedTransport([Chunk(1, b'1\n2', 'a'), Chunk(2, b'3\n', 'b')], True),
                          DigitFraming())
    arrivals = device.read(0.0) + device.read(0.0)
    assert [(a.source, a.reading.field[0]) for a in arrivals] == [('a', 1.0), ('b', 3.0)]
    assert_counts(device.counts, {'dropped': 2, 'between': 1})


def test_numbers_skipped_while_closed_are_not_lost():
    """Gaps in the sequence numbers are counted only while the driver is open."""
    def readings_of(*numbers):
        return [Reading('', (float(n), 0.0, 0.0), sequence=n) for n in numbers]
    driver, *_ = driver_of([readings_of(1, 2), readings_of(50, 51, 53)])
    poll_samples(driver, 0.1)
    driver.close()
    assert len(poll_samples(driver, 0.1)) == 3
    assert driver.counts()['lost: mag_1'] == 1
    driver, *_ = driver_of([readings_of(1, 2), readings_of(50, 51, 53)])
    poll_samples(driver, 0.1)
    poll_samples(driver, 0.1)
    assert driver.counts()['lost: mag_1'] == 48
