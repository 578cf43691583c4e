"""Detection of stuck sensors by means of the targets that other sensors detect."""

import numpy as np
import pytest

from mag_tracking.apps.doctor import Doctor
from mag_tracking.pipeline import Pipeline, settings_for
from support.calibration_runs import EARTH
from support.networks import line_network
from support.samples import MagSample, batch

STEP = 2e-7


def findings_of(last_amplitude, stuck_from, n_targets=4):
    """Findings, as texts, for three sensors with coarse resolution.

    The third sensor measures targets with an amplitude of `last_amplitude` [T]. From `stuck_from`
    [s] on, it repeats one reading.
    """
    network, samples = line_network(3), []
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 10.0 * (n_targets + 1), 0.02)
    stuck_field = None
    for s in t:
        pulse = sum(np.exp(-((s - 10.0 * k - 8.0) / 0.7)**2) for k in range(n_targets))
        for j, amplitude in enumerate((3e-6, 2e-6, last_amplitude)):
            field = EARTH + amplitude * pulse + 3e-8 * rng.standard_normal(3)
            field = STEP * np.round(field / STEP)
            if j == 2 and s >= stuck_from:
                stuck_field = field = field if stuck_field is None else stuck_field
            samples.append(MagSample(int(1e9 * s), f'mag_{j + 1}', field))
    doctor = Doctor(Pipeline(network, settings_for('vehicle'), 'calibrate'))
    for k in range(0, len(samples), 60):
        doctor.feed(batch(samples[k:k + 60]))
    return [str(f) for f in doctor.findings()]


@pytest.mark.parametrize('last_amplitude, stuck_from, missed', [
    (2e-6, np.inf, None), (5e-7, np.inf, None), (2e-6, 5.0, 4), (2e-6, 12.0, 3),
    (2e-6, 0.0, 4), (2e-6, 36.0, None)])
def test_a_stuck_sensor_misses_targets_of_other_sensors(last_amplitude, stuck_from, missed):
    found = [f for f in findings_of(last_amplitude, stuck_from) if 'did not change while' in f]
    if missed is None:
        assert found == []
    else:
        assert len(found) == 1 and found[0].startswith('mag_3: ')
        assert f' detected {missed} targets' in found[0]


def test_quiet_sensors_miss_no_targets():
    assert not any('did not change' in f for f in findings_of(2e-6, np.inf, n_targets=0))
