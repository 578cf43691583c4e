"""Plausibility of vehicle states: height, mounting angles, speed and position on the road."""

from types import SimpleNamespace

import numpy as np
import pytest

from mag_tracking.pipeline import settings_for
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import vehicle_model
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.plausibility import Plausibility, lane_note
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


def doubts_of(plausibility, observation, x, dt=0.08, mounting=MOUNTING, origin=0):
    bank = SimpleNamespace(x=x[None], kind=np.array([1]), origin=np.array([origin]))
    return plausibility.evaluate(observation, bank, 0, SETTINGS.vehicle, mounting, dt)


def doubts_in_state(mounting=MOUNTING, dt=0.08, **of_state):
    observation = Observation(NETWORK, vehicle_model(SETTINGS.vehicle, NETWORK), mounting, 0.3)
    return doubts_of(Plausibility(), observation, state(observation, **of_state), dt, mounting)


@pytest.mark.parametrize('of_state, expected', [
    ({}, set()),
    ({'z': 1.1}, set()), ({'z': 1.2}, {doubts.HEIGHT}),
    # Below the sensors, as after an exchange of two parallel sensors.
    ({'z': -0.3}, {doubts.HEIGHT, doubts.BELOW_SENSORS}),
    # The squares of six angles of 1.2 standard deviations add up to 8.6; one correct mounting in
    # twenty exceeds 12.6.
    ({'angles_deg': 6.0}, set()), ({'angles_deg': 8.0}, {doubts.SENSORS_ROTATED}),
    ({'angles_deg': -8.0}, {doubts.SENSORS_ROTATED}),
    ({'mounting': 0.0}, set()),
    # The vehicle is 4.5 m from both sensors, or above one of them.
    ({'speed': 40.0}, set()), ({'speed': 45.0}, {doubts.FRAMES_TOO_LONG}),
    ({'speed': 45.0, 'dt': 0.04}, set()), ({'speed': 40.0, 'at': (0.0, 4.4)}, set()),
    # The limit is 1.645 standard deviations of 1.5 m beyond the outermost lane at 4 m, except for
    # stationary vehicles.
    ({'at': (0.0, 6.4)}, set()), ({'at': (0.0, 6.5)}, {doubts.OFF_THE_ROAD}),
    ({'at': (30.0, -6.5)}, {doubts.OFF_THE_ROAD}), ({'at': (0.0, 6.5), 'speed': 0.9}, set())])
def test_implausible_states_are_flagged(of_state, expected):
    assert doubts_in_state(**of_state) == expected


@pytest.mark.parametrize('positions, has_note', [
    ([(0.0, 0.0), (10.0, 0.0)], True), ([(0.0, 0.0), (10.0, 1.5), (20.0, 0.0)], True),
    ([(0.0, -4.5), (0.0, 4.5)], False), ([(0.0, 0.0), (10.0, 5.0)], False),
    ([(0.0, 0.0), (0.5, 0.0)], False), ([(0.0, 0.0)], False)])
def test_the_covered_lanes_are_stated_if_all_sensors_stand_on_one_side(positions, has_note):
    note = lane_note(SETTINGS.vehicle, network_of([(x, y, 0.0) for x, y in positions]))
    assert (note is not None) == has_note
    if note:
        # As for the doubt: 4 m and 1.645 standard deviations of 1.5 m.
        assert 'track.vehicle.lateral_offsets' in note and '6.5 m' in note


def observation_of(network=NETWORK):
    return Observation(network, vehicle_model(SETTINGS.vehicle, network), MOUNTING, 0.3)


@pytest.mark.parametrize('y, after, expected', [
    (0.0, 8.0, set()), (8.0, 0.0, {doubts.OFF_THE_ROAD}), (0.0, 8.6, {doubts.OFF_THE_ROAD})])
def test_a_path_is_evaluated_where_it_is_nearest_to_a_sensor(y, after, expected):
    """A vehicle that has passed the sensors may turn off the road, up to the limit
    `LANE_STDS_LATER`.

    A vehicle that was off the road at its closest point stays doubtful, even after it has stopped.
    """
    plausibility, observation = Plausibility(), observation_of()
    for x, aside, speed in ((-20.0, 0.0, 10.0), (0.0, y, 10.0), (20.0, after, 10.0)):
        found = doubts_of(plausibility, observation, state(observation, at=(x, aside), speed=speed))
    assert found == expected
    for at in ((22.0, after), (0.0, y)):
        standing = doubts_of(plausibility, observation, state(observation, at=at, speed=0.5))
        assert standing == (expected if y else set())


def test_the_path_of_each_hypothesis_is_stored():
    """The doubts about a hypothesis depend on its earlier states, even if these were not
    published."""
    plausibility, observation = Plausibility(), observation_of()
    paths = {5: ((0.0, 7.0), (4.0, 0.0)), 2: ((0.0, 1.0), (4.0, 7.0))}
    for k in range(2):
        bank = SimpleNamespace(x=np.array([state(observation, at=at[k]) for at in paths.values()]),
                               kind=np.array([1, 1]), origin=np.array(list(paths)))
        found = [plausibility.evaluate(observation, bank, best, SETTINGS.vehicle, MOUNTING, 0.08)
                 for best in range(2)]
        assert found == [{doubts.OFF_THE_ROAD}, set()]


@pytest.mark.parametrize('half_width, edge', [
    (1.0, 6.47), (4.5, 6.47), (5.0, 6.47), (6.0, 8.0), (8.0, 12.0), (9.0, 13.0)])
def test_a_vehicle_may_pass_outside_a_wide_network(half_width, edge):
    """A vehicle may pass as far outside the outermost sensor as this sensor lies outside the
    outermost lane. The margin is limited to the distance of this lane from the centre."""
    network = network_of([[0.0, -half_width, 0.0], [0.0, 0.0, 0.0], [0.0, half_width, 0.0]])
    observation = observation_of(network)
    x = np.zeros(observation.n_target + (observation.n_own + 3) * 3)
    for y, expected in ((edge - 0.1, set()), (edge + 0.1, {doubts.OFF_THE_ROAD})):
        x[:5] = 0.0, y, 0.5, 10.0, 0.0
        assert doubts_of(Plausibility(), observation, x) == expected
