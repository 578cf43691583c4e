"""Bank size: settings that exceed the memory limits are rejected before a track starts."""

import numpy as np
import pytest

from mag_tracking.errors import SettingsError
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import target
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.target import target_of
from support.bundled import POINT
from support.networks import line_network


@pytest.mark.parametrize('target, changes, product', [
    ('vehicle', {'track.vehicle.speeds': [1.0 + 1e-3 * k for k in range(100_000)]},
     'speeds (100000)'),
    ('vehicle', {**POINT, 'track.vehicle.lateral_offsets': [1e-3 * k for k in range(10_000)]},
     'lateral_offsets (10000)'),
    ('vehicle', {'track.vehicle.arrival_names': [str(k) for k in range(3000)],
                 'track.vehicle.arrival_headings_deg': [0.1 * k for k in range(3000)]},
     'arrival_names (3000)')])
def test_too_many_hypotheses_are_rejected_with_their_number(target, changes, product):
    with pytest.raises(SettingsError) as error:
        Pipeline(line_network(2), settings_for(target, changes))
    assert str(error.value).startswith(f'track.{target}: ') and product in str(error.value)


def test_too_many_hypotheses_of_a_magnet_are_rejected():
    settings = settings_for('magnet', {'track.mounting_std_deg': 5.0, 'track.max_sensors': 600,
                                       'track.model_error_time_s': 0.3})
    Pipeline(line_network(9), settings)
    with pytest.raises(SettingsError) as error:
        Pipeline(line_network(600), settings)
    assert 'track.magnet: 24 starting hypotheses, optima (24), with 5412 states each for 600 ' \
        'sensors (track.max_sensors) need 5.62 GB of memory' in str(error.value)


def bytes_at_start(n, settings):
    """Memory [bytes] of the covariances of all hypotheses of a vehicle at the start of its track.

    The network has `n` sensors.
    """
    network = line_network(n)
    target = target_of(settings, network)
    frame = FieldFrame(0, np.full((n, 3), 1e-7), np.repeat(1e-16 * np.eye(3)[None], n, axis=0),
                       np.full(n, 8), np.zeros(n))
    own = BankFilter(network, target.model, settings).observation.own_covariance
    return target.start(settings, network, frame, own).P.nbytes


@pytest.mark.parametrize('n', [2, 5])
@pytest.mark.parametrize('changes', [
    {}, POINT, {'track.mounting_std_deg': 0.0}, {'track.model_error_time_s': 0.0},
    {'track.vehicle.turn_acceleration': 0.0, 'track.vehicle.speeds': [3.0, 9.0]}])
def test_the_limit_applies_to_the_size_of_the_actual_bank(monkeypatch, n, changes):
    network, settings = line_network(n), settings_for('vehicle', changes).track
    size = bytes_at_start(n, settings)
    monkeypatch.setattr(target, 'MAX_BYTES', size)
    target_of(settings, network)
    monkeypatch.setattr(target, 'MAX_BYTES', size - 1)
    with pytest.raises(SettingsError, match='starting hypotheses'):
        target_of(settings, network)


@pytest.mark.parametrize('changes', [{}, POINT, {'track.mounting_std_deg': 0.0}])
def test_the_number_of_sensors_at_the_start_is_limited_by_memory(monkeypatch, changes):
    settings = settings_for('vehicle', changes).track
    model = target_of(settings, line_network(2)).model
    monkeypatch.setattr(target, 'START_BYTES', bytes_at_start(6, settings))
    for n, expected in ((2, 2), (6, 6), (7, 6), (40, 6)):
        assert target.sensors_at_start(settings, line_network(n), model) == expected
    monkeypatch.setattr(target, 'START_BYTES', target.START_BYTES - 1)
    assert target.sensors_at_start(settings, line_network(40), model) == 5
    monkeypatch.setattr(target, 'START_BYTES', 1)
    assert target.sensors_at_start(settings, line_network(40), model) == 4
    assert target.sensors_at_start(settings, line_network(3), model) == 3


def test_a_magnet_starts_with_max_sensors():
    settings, network = settings_for('magnet').track, line_network(40)
    model = target_of(settings, network).model
    assert target.sensors_at_start(settings, network, model) == settings.max_sensors


@pytest.mark.parametrize('n', [2, 16, 32, 90])
def test_the_number_of_retained_hypotheses_is_limited_by_memory(n):
    settings, network = settings_for('vehicle').track, line_network(2)
    observation = BankFilter(network, target_of(settings, network).model, settings).observation
    n_hyp, size = target.max_hypotheses(observation, n), 8 * observation.n_states(n)**2
    assert (n_hyp == target.MIN_HYPOTHESES if n == 90
            else n_hyp * size <= target.WIDER_BYTES < (n_hyp + 1) * size)


def test_more_sensors_than_fit_into_memory_are_rejected():
    changes = {'track.max_sensors': 1000}
    Pipeline(line_network(90), settings_for('vehicle', changes))
    with pytest.raises(SettingsError, match='track.max_sensors: 100 .*400 sensors .*10.5 GB'):
        Pipeline(line_network(400), settings_for('vehicle', changes))
