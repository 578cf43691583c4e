"""States that no vehicle on the road has."""

from types import SimpleNamespace

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


def judged(plausibility, observation, x, dt=0.08, mounting=MOUNTING, origin=0):
    bank = SimpleNamespace(x=x[None], kind=np.array([1]), origin=np.array([origin]))
    return plausibility.evaluate(observation, bank, 0, SETTINGS.vehicle, mounting, dt)


def found(mounting=MOUNTING, dt=0.08, **of_state):
    observation = Observation(NETWORK, vehicle_model(SETTINGS.vehicle, NETWORK), mounting, 0.3)
    return judged(Plausibility(), observation, state(observation, **of_state), dt, mounting)


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


def observed_by(network=NETWORK):
    return Observation(network, vehicle_model(SETTINGS.vehicle, network), MOUNTING, 0.3)


@pytest.mark.parametrize('y, after, expected', [
    (0.0, 8.0, set()), (8.0, 0.0, {doubts.OFF_THE_ROAD}), (0.0, 8.6, {doubts.OFF_THE_ROAD})])
def test_a_path_is_judged_where_it_is_nearest_to_a_sensor(y, after, expected):
    """A vehicle that turns off afterwards stays believed, unless it goes where none does, and one
    beside the road stays doubted, also where it stops.
    """
    plausibility, observation = Plausibility(), observed_by()
    for x, aside, speed in ((-20.0, 0.0, 10.0), (0.0, y, 10.0), (20.0, after, 10.0)):
        said = judged(plausibility, observation, state(observation, at=(x, aside), speed=speed))
    assert said == expected
    for at in ((22.0, after), (0.0, y)):
        stands = judged(plausibility, observation, state(observation, at=at, speed=0.5))
        assert stands == (expected if y else set())


def test_each_hypothesis_has_a_path_of_its_own():
    """It is remembered while another hypothesis is published, too."""
    plausibility, observation = Plausibility(), observed_by()
    paths = {5: ((0.0, 7.0), (4.0, 0.0)), 2: ((0.0, 1.0), (4.0, 7.0))}
    for k in range(2):
        bank = SimpleNamespace(x=np.array([state(observation, at=at[k]) for at in paths.values()]),
                               kind=np.array([1, 1]), origin=np.array(list(paths)))
        said = [plausibility.evaluate(observation, bank, best, SETTINGS.vehicle, MOUNTING, 0.08)
                for best in range(2)]
        assert said == [{doubts.OFF_THE_ROAD}, set()]


@pytest.mark.parametrize('half_width, edge', [
    (1.0, 6.47), (4.5, 6.47), (5.0, 6.47), (6.0, 8.0), (8.0, 12.0), (9.0, 13.0)])
def test_a_vehicle_may_pass_a_wide_network_outside(half_width, edge):
    """As far outside as the network is wider than the road, and at most as far as a lane is from
    the middle.
    """
    network = network_of([[0.0, -half_width, 0.0], [0.0, 0.0, 0.0], [0.0, half_width, 0.0]])
    observation = observed_by(network)
    x = np.zeros(observation.n_target + (observation.n_own + 3) * 3)
    for y, expected in ((edge - 0.1, set()), (edge + 0.1, {doubts.OFF_THE_ROAD})):
        x[:5] = 0.0, y, 0.5, 10.0, 0.0
        assert judged(Plausibility(), observation, x) == expected
