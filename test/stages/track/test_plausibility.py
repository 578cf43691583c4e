"""States that no vehicle on the road has."""

import numpy as np
import pytest

from mag_tracking.pipeline import settings_for
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import vehicle_model
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.plausibility import Plausibility
from support.networks import line_network
from support.passes import network_of

SETTINGS = settings_for('vehicle').track
NETWORK = line_network(2)
MOUNTING = np.deg2rad(5.0)


def state(observation, z=0.5, speed=10.0, at=(0.0, 0.0), angles_deg=0.0):
    x = np.zeros(observation.n_target + (observation.n_own + 3) * 2)
    x[:5] = *at, z, speed, 0.0
    observation.own(x)[..., :3] = np.deg2rad(angles_deg)
    return x


def found(mounting=MOUNTING, dt=0.08, **of_state):
    observation = Observation(NETWORK, vehicle_model(SETTINGS.vehicle, NETWORK), mounting, 0.3)
    return Plausibility().doubts(observation, state(observation, **of_state), 1,
                                 SETTINGS.vehicle, mounting, dt)


@pytest.mark.parametrize('of_state, expected', [
    ({}, set()),
    ({'z': 1.1}, set()), ({'z': 1.2}, {doubts.HEIGHT}), ({'z': -0.3}, {doubts.HEIGHT}),
    # 1.2 deviations of each of six angles are 8.6; 12.6 is exceeded by one mounting in twenty.
    ({'angles_deg': 6.0}, set()), ({'angles_deg': 8.0}, {doubts.SENSORS_ROTATED}),
    ({'angles_deg': -8.0}, {doubts.SENSORS_ROTATED}),
    ({'mounting': 0.0}, set()),
    # 4.5 m from both sensors, or over one of them.
    ({'speed': 40.0}, set()), ({'speed': 45.0}, {doubts.FRAMES_TOO_LONG}),
    ({'speed': 45.0, 'dt': 0.04}, set()), ({'speed': 40.0, 'at': (0.0, 4.4)}, set()),
    # 1.645 deviations of 1.5 m beyond the outermost lane, at 4 m; a standing one goes nowhere.
    ({'at': (0.0, 6.4)}, set()), ({'at': (0.0, 6.5)}, {doubts.OFF_THE_ROAD}),
    ({'at': (30.0, -6.5)}, {doubts.OFF_THE_ROAD}), ({'at': (0.0, 6.5), 'speed': 0.9}, set())])
def test_states_that_no_vehicle_has(of_state, expected):
    assert found(**of_state) == expected


@pytest.mark.parametrize('y, after, expected', [
    (0.0, 8.0, set()), (8.0, 0.0, {doubts.OFF_THE_ROAD}), (0.0, 8.6, {doubts.OFF_THE_ROAD})])
def test_a_path_is_judged_where_it_is_nearest_to_a_sensor(y, after, expected):
    """A vehicle that turns off afterwards stays believed, unless it goes where none does, and one
    beside the road stays doubted."""
    plausibility = Plausibility()
    observation = Observation(NETWORK, vehicle_model(SETTINGS.vehicle, NETWORK), MOUNTING, 0.3)
    for x, aside in ((-20.0, 0.0), (0.0, y), (20.0, after)):
        said = plausibility.doubts(observation, state(observation, at=(x, aside)), 1,
                                   SETTINGS.vehicle, MOUNTING, 0.08)
    assert said == expected


@pytest.mark.parametrize('y, expected', [(12.9, set()), (13.1, {doubts.OFF_THE_ROAD})])
def test_past_a_network_that_is_wider_than_the_road_a_vehicle_is_as_near_to_its_edge(y, expected):
    """As the outermost lane is to the middle: 4 m from the sensor at 9 m."""
    network = network_of([[0.0, -9.0, 0.0], [0.0, 0.0, 0.0], [0.0, 9.0, 0.0]])
    observation = Observation(network, vehicle_model(SETTINGS.vehicle, network), MOUNTING, 0.3)
    x = np.zeros(observation.n_target + (observation.n_own + 3) * 3)
    x[:5] = 0.0, y, 0.5, 10.0, 0.0
    assert Plausibility().doubts(observation, x, 1, SETTINGS.vehicle, MOUNTING, 0.08) == expected
