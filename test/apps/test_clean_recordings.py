"""The doctor finds no error in recordings of sensors without faults, of any rate and resolution."""

import numpy as np
import pytest

from mag_tracking.apps.doctor import Doctor
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.stages.calibrate.prescan import prescan
from mag_tracking.stages.health.diagnosis import ranked
from support.marks import studied
from support.random_passes import SIMULATORS
from support.situation_worlds import ambient_world, uniform
from support.spoiler import apply, steps

NOISE = 1.2e-8
SEEDS = range(30)


def clean_recording(simulator, seed):
    """Cars that pass sensors with steps of 0.3 to 3 times the noise, at 5 to 200 Hz."""
    rng = np.random.default_rng([seed, SIMULATORS.index(simulator)])
    rate, step = 5.0 * 40.0 ** rng.random(), 0.3 * 10.0 ** rng.random()
    calm = uniform(np.zeros(3), np.zeros_like)
    world = ambient_world(rng, simulator, calm, 60.0, rate, cars=int(rng.integers(0, 4)))
    return world.network, apply(world.readings, steps(step * NOISE))


@pytest.mark.parametrize('seed', studied(SEEDS, kept=range(3)))
@pytest.mark.parametrize('simulator', SIMULATORS)
def test_the_doctor_finds_no_error_in_a_clean_recording(simulator, seed):
    network, readings = clean_recording(simulator, seed)
    settings = settings_for('vehicle')
    doctor = Doctor(Pipeline(network, settings, 'calibrate'))
    prescan([readings], network, settings.calibrate).apply(doctor.calibrate)
    for k in range(0, len(readings), 1000):
        doctor.feed(readings.part(slice(k, k + 1000)))
    errors = [str(d) for d in ranked(doctor.findings()) if d.serious]
    assert not errors
    assert not any(doctor.calibrate.driver_faults.of(name) for name in network.names)
    assert not any(health.counts['saturated'] for health in doctor.sensors.values())
