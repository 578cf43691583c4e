"""A long vehicle: where its middle is, before and after all of it has been felt."""

import numpy as np
import pytest

from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.stages.track.published_pose import smoothed_pose, vehicle_orientation
from mag_tracking.stages.track.unseen_length import CAR_ROW, OFF_MIDDLE, UnseenLength

SENSORS = np.array([[0.0, 4.0, 0.0], [1.0, -4.0, 0.0]])


def at(place, heading=0.0, speed=8.0):
    x = np.zeros(17)
    x[:2], x[3:5] = place, [speed * np.cos(heading), speed * np.sin(heading)]
    return x


def test_the_middle_of_a_long_vehicle_is_less_certain_than_that_of_its_iron():
    """Along the heading, by a share of what it is longer than a car; a car as the filter says."""
    model, unseen = RowVehicle(np.zeros(3), np.ones(3)), UnseenLength([3.0], [1.0], SENSORS)
    x, P = at([0.0, 0.0], 0.5 * np.pi), 0.04 * np.eye(17)
    said = {}
    for length in (3.0, -3.0, 12.0):
        x[16] = length
        said[length] = smoothed_pose(
            model, vehicle_orientation, x, P, unseen=unseen, stamp_ns=0, id=1, kind='',
            ambiguous=False, complete=True).covariance
    np.testing.assert_array_equal(said[3.0], P[:6, :6])
    np.testing.assert_array_equal(said[-3.0], P[:6, :6])
    expected = np.zeros((6, 6))
    expected[1, 1] = (OFF_MIDDLE * (12.0 - CAR_ROW))**2
    np.testing.assert_allclose(said[12.0] - P[:6, :6], expected, atol=1e-12)


def test_a_car_that_comes_may_be_the_head_of_a_truck():
    """The law of a mixture: a third of the vehicles have their middle three metres behind."""
    unseen = UnseenLength([0.0, 3.0, 9.0], [0.0, 1.0, 3.0], SENSORS)
    added = unseen.covariance(at([-20.0, 0.0]), 3.0)
    rng = np.random.default_rng(0)
    is_truck = rng.random(400_000) < 1.0 / 3.0
    behind = is_truck * 0.5 * (9.0 + 3.0 * rng.standard_normal(len(is_truck)) - 3.0)
    assert added[0, 0] == pytest.approx(np.square(behind).mean(), rel=0.02)
    assert not added[1].any() and not added[:, 1].any()


@pytest.mark.parametrize('heading', [0.0, 2.0, np.pi])
def test_once_a_truck_would_have_been_felt_a_car_is_one(heading):
    unseen = UnseenLength([3.0, 9.0], [1.0, 3.0], np.zeros((1, 3)))
    forward = np.array([np.cos(heading), np.sin(heading)])
    assert unseen.covariance(at(2.9 * forward, heading), 3.0).any()
    assert not unseen.covariance(at(3.1 * forward, heading), 3.0).any()


def test_what_nothing_is_longer_than_has_been_seen():
    long_one = UnseenLength([3.0, 9.0], [1.0, 3.0], SENSORS)
    only_cars = UnseenLength([3.0], [1.0], SENSORS)
    coming = at([-20.0, 0.0])
    assert not only_cars.covariance(coming, 3.0).any()
    np.testing.assert_allclose(long_one.covariance(coming, 9.0),
                               long_one.covariance(coming, 9.0, complete=True))
    assert not long_one.covariance(coming, 3.0, complete=True).any()
    # At rest it has no heading to be long along.
    assert not long_one.covariance(at([-20.0, 0.0], speed=0.0), 3.0).any()
