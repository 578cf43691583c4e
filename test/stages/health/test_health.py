"""Sensor health and `doctor`: each fault is reported, and valid sensors have no findings."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.apps.doctor import Doctor, examine
from mag_tracking.cli import main
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.run import RecordingSource
from mag_tracking.stages.health.diagnosis import ranked
from mag_tracking.stages.health.sensor_health import WINDOW, SensorHealth
from mag_tracking.stages.health.window import ReadingBuffer, quantiles
from support.bundled import DATA, NETWORK_FILE, VEHICLES, vehicle_path
from support.networks import line_network
from support.samples import MagSample, one, sample_dict

NS = 10**9
EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])
SIGMA = 1.2e-8


def readings(n=3000, rate=100.0, seed=0):
    """Simulate a valid sensor; return (timestamps [ns], fields)."""
    rng = np.random.default_rng(seed)
    return (10**18 + (np.arange(n) * NS / rate).astype(np.int64),
            EARTH + SIGMA * rng.standard_normal((n, 3)))


def examined(stamps, fields, received=None):
    """Feed readings to a `SensorHealth`, and return it."""
    health = SensorHealth()
    for k, (stamp, field) in enumerate(zip(stamps, fields, strict=True)):
        health.add(int(stamp), field, None if received is None else int(received[k]))
    return health


def texts(health, **arguments):
    return [str(f) for f in health.findings('mag_1', **arguments)]


def test_a_valid_sensor_has_no_findings():
    stamps, fields = readings()
    health = examined(stamps, fields, stamps + 2_000_000)
    assert texts(health, noise_std=np.full(3, SIGMA)) == []
    assert health.rate == pytest.approx(100.0, rel=1e-6)
    # Second differences overlap, so only an eighth of them is independent.
    np.testing.assert_allclose(health.noise_std, SIGMA, rtol=5 / np.sqrt(WINDOW / 2))
    np.testing.assert_allclose(health.field, EARTH, atol=5 * SIGMA / np.sqrt(WINDOW) * 1.3)
    np.testing.assert_allclose(health.delay_s, 2e-3, rtol=1e-6)


def test_noise_is_estimated_despite_coarse_steps_or_a_passing_target():
    stamps, fields = readings()
    passing = fields + 3e-6 * np.exp(-0.5 * ((np.arange(3000) - 2750) / 60) ** 2)[:, None]
    np.testing.assert_allclose(examined(stamps, passing).noise_std, SIGMA, rtol=0.3)
    coarse = np.round(fields / 2e-8) * 2e-8
    expected = np.sqrt(SIGMA**2 + 2e-8**2 / 12)
    np.testing.assert_allclose(examined(stamps, coarse).noise_std, expected, rtol=0.3)


def faulty(fault):
    """Simulate a sensor with a fault; return (timestamps, fields, times of receipt)."""
    stamps, fields = readings()
    received = stamps + 1_000_000
    if fault == 'lost':
        keep = np.random.default_rng(1).random(3000) > 0.05
        stamps, fields, received = stamps[keep], fields[keep], received[keep]
    elif fault == 'twice':
        stamps, fields, received = (np.repeat(a, 2, axis=0) for a in (stamps, fields, received))
    elif fault == 'back':
        stamps[1500:] -= 5 * NS
    elif fault == 'step':
        stamps[1500:] += NS
    elif fault in ('late', 'zone, slow computer'):
        received = received + (np.random.default_rng(2).random(3000) * 0.12 * NS).astype(np.int64)
        received += 7200 * NS * (fault != 'late')
    elif fault == 'ahead':
        stamps = stamps + 3 * NS
    elif fault == 'stuck':
        fields[2000:2400] = fields[2000]
    elif fault == 'saturated':
        fields[1000:1200, 1] = np.minimum(1.55e-5 + 1e-6 * np.sin(np.arange(200) / 6.0), 1.6e-5)
        fields[1000:1200, 1] = np.maximum(fields[1000:1200, 1], 1.5e-5)
    elif fault == 'spikes':
        fields[::200] += 1e-4
    elif fault == 'dead':
        fields[:, 0] = fields[0, 0]
    elif fault == 'axis':
        fields[::10, 2] = np.nan
    elif fault == 'nothing':
        fields[::10] = np.nan
    elif fault == 'gauss':
        fields = fields * 1e4
    elif fault == 'noisy':
        fields[:, 1] += 10 * SIGMA * np.random.default_rng(3).standard_normal(3000)
    return stamps, fields, received


@pytest.mark.parametrize('fault, serious, message', [
    ('lost', False, 'were lost, '),
    ('twice', False, '3000 of 6000 '),
    ('back', True, 'back once'),
    ('step', True, 'clock stepped'),
    ('late', False, 'ms to arrive'),
    ('zone, slow computer', False, 'is 7200.1 s'),
    ('ahead', False, '-3.0 s'),
    ('stuck', True, 'are identical'),
    ('saturated', True, 'the range'),
    ('spikes', False, '14 of 3000 '),
    ('dead', True, 'x does not'),
    ('axis', False, 'z is missing'),
    ('nothing', True, '300 of 3000 '),
    ('gauss', True, '0.49 T'),
    ('noisy', False, 'y is 10 times'),
])
def test_each_fault_is_reported(fault, serious, message):
    health = examined(*faulty(fault))
    findings = health.findings('mag_1', noise_std=np.full(3, SIGMA))
    match = [f for f in findings if message in str(f)]
    assert len(match) == 1 and match[0].serious == serious, [str(f) for f in findings]
    assert match[0].subject == 'mag_1' and match[0].advice
    # A backward timestamp is also a clock step.
    assert len(findings) == 1 + (fault == 'back'), [str(f) for f in findings]


def test_a_sensor_with_noise_below_its_resolution_has_no_spikes():
    stamps, fields = readings()
    coarse = np.round(fields / 2e-7) * 2e-7
    coarse[::50] += 2e-7
    health = examined(stamps, coarse)
    assert health.counts['spikes'] == 0 and (health.noise_std > 2e-8).all()


def test_a_stalled_host_is_not_a_clock_step():
    """Readings that are delayed by the host arrive in a burst."""
    stamps, fields = readings()
    received = stamps + 1_000_000
    for first in range(500, 3000, 500):
        until = received[first] + 400_000_000
        received[first:] = np.maximum(received[first:], until)
    findings = texts(examined(stamps, fields, received))
    assert not any('stepped' in text for text in findings), findings


def test_lost_readings_are_counted():
    stamps, fields = readings()
    keep = np.ones(3000, dtype=bool)
    keep[[500, 900, 901, 902, 2000]] = False
    assert examined(stamps[keep], fields[keep]).counts['lost'] == 5
    # An interval of 1.4 periods means a late reading; an interval of 1.7 periods, a lost reading.
    for n_periods, lost in ((1.4, 0), (1.7, 1)):
        later = np.array(stamps)
        later[1500:] += round((n_periods - 1.0) * 1e7)
        assert examined(later, fields).counts['lost'] == lost


def test_a_steep_slope_is_not_a_spike():
    stamps, fields = readings()
    fields[1500:1520] += 1e-6 * np.arange(20)[:, None]
    fields[1520:] += 2e-5
    assert examined(stamps, fields).counts['spikes'] == 0


def test_a_fast_pass_near_the_sensor_has_no_spikes():
    """The readings next to an isolated spike agree; near a peak, each reading differs."""
    stamps, fields = readings()
    for size in (1e-5, 1e-4, 1e-3):
        t = (np.arange(3000) - 1500.3)[:, None] / 100.0
        passing = fields + [size, -size, size] / (1.0 + (t / 0.1)**2)**1.5
        assert examined(stamps, passing).counts['spikes'] == 0
    fields[1500] += 1e-6
    assert examined(stamps, fields).counts['spikes'] == 1


def test_saturated_readings_are_counted_once():
    stamps, fields, _ = faulty('saturated')
    clipped = np.isin(fields[:, 1], [1.5e-5, 1.6e-5]).sum()
    assert examined(stamps, fields).counts['saturated'] == clipped


def test_a_stuck_two_axis_sensor_is_found():
    stamps, fields, _ = faulty('stuck')
    fields[:, 2] = np.nan
    assert examined(stamps, fields).counts['stuck readings'] == 299


def test_a_sensor_with_an_irregular_rate_has_no_lost_readings():
    rng = np.random.default_rng(4)
    stamps = 10**18 + np.cumsum(rng.exponential(0.01, 3000) * NS).astype(np.int64)
    assert examined(stamps, readings()[1]).counts['lost'] == 0


def test_a_two_axis_sensor_has_no_findings():
    stamps, fields = readings()
    fields[:, 2] = np.nan
    assert texts(examined(stamps, fields), noise_std=np.array([SIGMA, SIGMA, SIGMA])) == []


def test_a_sensor_without_readings_is_reported():
    assert ['no reading' in t for t in texts(SensorHealth())] == [True]


def doctor_findings(change=lambda k, field: field, seconds=10.0, **settings):
    """Diagnoses of `Doctor` for three sensors; `change` modifies the fields of the second one."""
    network = line_network(3)
    doctor = Doctor(Pipeline(network, settings_for('vehicle', settings), 'calibrate'))
    rng = np.random.default_rng(5)
    for k in range(int(seconds * 50)):
        for j, name in enumerate(network.names):
            field = network.R_sw[j] @ network.earth_field + SIGMA * rng.standard_normal(3)
            if j == 1:
                field = change(k, field)
            doctor.feed(one(MagSample(10**18 + k * 20_000_000, name, field)))
    return [str(d) for d in ranked(doctor.findings())]


def test_a_target_that_stays_causes_no_findings():
    """Sensors are compared by their backgrounds, which are frozen while the target is present."""
    assert doctor_findings(lambda k, field: field + 2e-5 * (k > 750), seconds=25.0) == []


def test_the_doctor_compares_sensors_with_the_earth_field():
    assert doctor_findings() == []
    findings = doctor_findings(lambda k, field: field * [1.0, -1.0, 1.0])
    assert len(findings) == 1 and "mag_2: differs" in findings[0]
    assert 'y is' in findings[0]
    findings = doctor_findings(lambda k, field: field * 1e6)
    assert any('is microtesla' in text for text in findings), findings
    assert any(text.startswith('mag_2:') and '500 readings rejected: above' in text
               for text in findings), findings
    # The first spike is not counted, because the noise is not known yet.
    few = doctor_findings(lambda k, field: field * (1e6 if k % 100 == 1 else 1.0), seconds=20.0)
    assert few[0].startswith('mag_2: 9 of 1000 ')
    assert '10 readings rejected' in few[0]


def test_a_background_in_the_file_does_not_hide_a_flipped_axis():
    network = line_network(3)
    backgrounds = tuple(network.R_sw[j] @ network.earth_field for j in range(3))
    doctor = Doctor(Pipeline(replace(network, background=backgrounds), settings_for('vehicle'),
                             'calibrate'))
    rng = np.random.default_rng(6)
    for k in range(600):
        for j, name in enumerate(network.names):
            field = backgrounds[j] * ([1.0, 1.0, -1.0] if j == 2 else np.ones(3))
            doctor.feed(one(MagSample(k * 20_000_000, name,
                                      field + SIGMA * rng.standard_normal(3))))
    findings = [str(d) for d in ranked(doctor.findings())]
    assert "mag_3: differs" in findings[0]
    assert 'z is' in findings[0]


def test_without_an_earth_field_sensors_are_compared_with_each_other():
    for n, message in ((3, "mag_2: differs from the Earth's field by"),
                       (2, 'network: sensors were not compared')):
        network = replace(line_network(n), earth_field=None)
        doctor = Doctor(Pipeline(network, settings_for('vehicle'), 'calibrate'))
        rng = np.random.default_rng(7)
        for k in range(400):
            for j, name in enumerate(network.names):
                field = network.R_sw[j] @ EARTH * ([1.0, -1.0, 1.0] if j == 1 else np.ones(3))
                doctor.feed(one(MagSample(k * 20_000_000, name,
                                          field + SIGMA * rng.standard_normal(3))))
        findings = [str(d) for d in ranked(doctor.findings())]
        assert len(findings) == 1 and findings[0].startswith(message), findings


def test_clocks_far_apart_are_reported_and_the_age_of_a_replay_is_not():
    for offset_ns, n in ((120 * NS, 1), (0, 0)):
        network = line_network(2)
        doctor = Doctor(Pipeline(network, settings_for('vehicle'), 'calibrate'))
        rng = np.random.default_rng(8)
        for k in range(400):
            received = 10**18 + k * 20_000_000
            for j, name in enumerate(network.names):
                field = network.R_sw[j] @ network.earth_field + SIGMA * rng.standard_normal(3)
                # All timestamps are years old, as in a replay.
                stamp = received - 10**17 - (offset_ns if j else 0)
                doctor.feed(one(MagSample(stamp, name, field)), received)
        findings = [str(d) for d in ranked(doctor.findings())]
        assert len(findings) == n, findings
        assert not n or findings[0].startswith('mag_2: ') and '-120 s' in findings[0]


def test_the_doctor_reports_frozen_relearnt_and_missing_backgrounds():
    # A background that was learnt only for a short time would be replaced earlier.
    steps = doctor_findings(lambda k, field: field + 1e-6 * (k > 1000), seconds=75.0)
    assert len(steps) == 2 and 'frozen for 5' in steps[1]
    assert 'is doubtful' in steps[0]
    parked = doctor_findings(lambda k, field: field + 1e-6 * (k > 1000), seconds=155.0)
    assert len(parked) == 1 and 'relearnt once' in parked[0]
    early = doctor_findings(seconds=2.0)
    assert len(early) == 3 and all('was learnt' in text for text in early)


@pytest.mark.parametrize('name', VEHICLES)
def test_the_doctor_finds_no_faults_in_the_bundled_recordings(name, road_network):
    source = RecordingSource(Recording(vehicle_path(name)), road_network, by_message=True)
    doctor, lost = examine(source, road_network, settings_for('vehicle'))
    findings = [str(d) for d in ranked(doctor.findings())]
    assert not lost and not findings


def test_the_doctor_finds_no_faults_in_the_corridor(capsys):
    """The largest readings of two sensors are equal by chance, far below the end of the range."""
    folder = DATA / 'corridor'
    assert main(['doctor', str(folder / 'corridor_8_sensors.mcap'), '--network',
                 str(folder / 'network.yaml')]) == 0
    assert 'the range' not in capsys.readouterr().out


def test_the_doctor_command_checks_a_recording_and_its_arguments(tmp_path, capsys):
    arguments = ['doctor', '--network', str(NETWORK_FILE)]
    assert main([*arguments, str(vehicle_path('straight_car_right'))]) == 0
    output = capsys.readouterr().out
    assert 'no faults' in output and '100.0 Hz      0 lost' in output
    assert main(arguments) == 1
    assert main([*arguments, 'x.mcap', '--live', '3']) == 1
    assert capsys.readouterr().err.count('give either RECORDING or --live SECONDS') == 2
    assert main([*arguments, '--live', '0']) == 1
    assert '--live: expected 1 to 86400 s, got 0' in capsys.readouterr().err


def test_the_doctor_command_reports_a_silent_sensor(tmp_path, capsys):
    stamps, fields = readings(500)
    network = read_network(NETWORK_FILE)
    with RecordingWriter(tmp_path / 'one.mcap') as writer:
        for stamp, field in zip(stamps.tolist(), fields, strict=True):
            writer.write('/mag_1/imu/mag', MAGNETIC_FIELD,
                         sample_dict(MagSample(stamp, 'mag_1', field), 'mag_1'), stamp)
    assert main(['doctor', str(tmp_path / 'one.mcap'), '--network', str(NETWORK_FILE)]) == 2
    output = capsys.readouterr().out
    assert 'ERROR mag_2: no reading' in output and 'mag_1: ' not in output
    assert len(network) == 2


@pytest.mark.parametrize('n', [1, 2, 7, 64, 513])
def test_quantiles_match_numpy(n):
    values, q = np.random.default_rng(n).standard_normal(n), (0.0, 0.05, 0.5, 0.6, 0.95, 1.0)
    np.testing.assert_allclose(quantiles(values, *q), np.quantile(values, q), rtol=1e-12)


def test_quantiles_of_an_empty_array_are_nan():
    assert np.isnan(quantiles(np.zeros(0), 0.1, 0.5)).tolist() == [True, True]


def test_batches_give_the_same_health_as_single_readings():
    """The arrays of each batch are overwritten after the call."""
    rng = np.random.default_rng(3)
    stamps = np.arange(700) * NS // 100
    fields = 1e-6 + 1e-8 * rng.standard_normal((700, 3))
    single, many = SensorHealth(update_interval=256), SensorHealth()
    for t, f in zip(stamps.tolist(), fields, strict=True):
        single.add(t, f, t + 10**6)
    for begin, end in ((0, 0), (0, 300), (300, 301), (301, 700)):
        arrays = stamps[begin:end].copy(), fields[begin:end].copy(), stamps[begin:end] + 10**6
        many.add_batch(*arrays)
        for array in arrays:
            array[:] = 0
    assert many.counts == single.counts and many.counts['readings'] == 700
    assert many.rate == single.rate == pytest.approx(100.0)
    np.testing.assert_array_equal(many.noise_std, single.noise_std)
    np.testing.assert_array_equal(many.field, single.field)
    assert many.delay_s == single.delay_s


def test_a_reading_buffer_returns_the_readings_of_each_sensor_in_order():
    """A full buffer accepts no readings until it has been emptied."""
    rng, buffer = np.random.default_rng(4), ReadingBuffer(5, 8)
    rows, stamps = rng.integers(-1, 5, 300), np.arange(300)
    fields, popped, i = rng.standard_normal((300, 3)), {j: [] for j in range(5)}, 0
    fields[7, 1] = np.nan

    def collect(j):
        popped[j] += [(int(t), f.tolist(), int(r)) for t, f, r in zip(*buffer.pop(j), strict=True)]

    while (i := buffer.add(rows, stamps, fields, 1000, i)) < len(rows):
        collect(rows[i])
    for j in range(5):
        collect(j)
        expected = [(k, fields[k].tolist(), 1000) for k in np.flatnonzero(rows == j).tolist()]
        assert repr(popped[j]) == repr(expected) and len(expected) > 30


def test_counts_do_not_depend_on_the_update_interval():
    """Faults between two updates are also counted."""
    rng, fields = np.random.default_rng(5), []
    for k in range(3000):
        stuck = k % 900 > 600
        fields.append(fields[-1] if stuck else 1e-5 + 1e-8 * rng.standard_normal(3))
    stamps = np.cumsum([NS // 100 * (40 if k % 256 == 0 else 1) for k in range(3000)])
    counts = []
    for update_interval in (1, 64, 256):
        health = SensorHealth(update_interval)
        for t, f in zip(stamps.tolist(), fields, strict=True):
            health.add(t, f)
        counts.append({k: health.counts[k] for k in ('readings', 'lost', 'stuck readings')})
    assert counts[1] == counts[2]
    assert counts[0]['stuck readings'] == counts[1]['stuck readings'] > 500
    assert counts[1]['lost'] > 300
