"""Uncertainty of the middle of a long vehicle, before and after the whole vehicle has passed."""

import numpy as np
import pytest

from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.stages.track.published_pose import (
    UnobservedLength,
    VehicleOrientation,
    smoothed_pose,
)

SENSORS = np.array([[0.0, 4.0, 0.0], [1.0, -4.0, 0.0]])
P = 0.04 * np.eye(19)
SMALL, CAR, TRUCK = range(3)


def unobserved_length_of_kinds():
    return UnobservedLength([0.0, 3.0, 9.0], [0.0, 1.0, 3.0])


def at(position, heading=0.0, speed=8.0):
    x = np.zeros(19)
    x[:2], x[3:5] = position, [speed * np.cos(heading), speed * np.sin(heading)]
    return x


def middle_offsets(length, half_std, is_sensed, n=400_000):
    """Samples of the offset [m] from the middle of a row of dipoles to that of its truck of 9 ± 3
    m."""
    rng = np.random.default_rng(0)
    hidden = 0.5 * (9.0 - length) + half_std * rng.standard_normal(n)
    return hidden * (rng.uniform(-1.0, 1.0, n) if is_sensed else -1.0)


@pytest.mark.parametrize('complete', [True, False])
@pytest.mark.parametrize('length', [5.0, -5.0])
def test_the_middle_of_a_long_vehicle_is_less_certain_than_that_of_its_iron(complete, length):
    """The variance along the heading accounts for the part of a truck beyond its row of dipoles.
    The covariance of a car is unchanged."""
    model, x, found = RowVehicle(np.zeros(3), np.ones(3)), at([0.0, 0.0], 0.5 * np.pi), {}
    x[18] = length
    for kind, mean_length, std in (('car', 3.0, 1.0), ('truck', 9.0, 3.0)):
        found[kind] = smoothed_pose(
            model, VehicleOrientation(), x, P,
            unobserved_length=UnobservedLength([mean_length], [std]), difference=np.zeros(6),
            stamp_ns=0, id=1, kind=0, kinds=(kind,), ambiguous=False,
            complete=complete).covariance - P[:6, :6]
    assert not found['car'].any()
    along = found['truck'][1, 1]
    assert along == pytest.approx(np.square(middle_offsets(5.0, 1.5, False)).mean(), rel=0.02)
    found['truck'][1, 1] = 0.0
    np.testing.assert_allclose(found['truck'], 0.0, atol=1e-12)


@pytest.mark.parametrize('length', [4.0, 8.9])
def test_a_truck_that_has_been_sensed_may_have_its_iron_at_either_end(length):
    unobserved_length = unobserved_length_of_kinds()
    for beyond in (-9.0, 8.0):
        unobserved_length.update(at([beyond, 0.0]), P, np.zeros((1, 3)), True)
        expected = np.square(middle_offsets(length, 1.5, beyond > 0.0)).mean()
        found = unobserved_length.covariance(at([beyond, 0.0]), P, length, TRUCK)
        assert found[0, 0] == pytest.approx(expected, rel=0.02)


def test_only_the_spread_of_lengths_remains_for_a_row_longer_than_its_kind():
    unobserved_length = unobserved_length_of_kinds()
    found = [unobserved_length.covariance(at([-9.0, 0.0]), P, length, TRUCK)[0, 0]
             for length in (9.0, 15.0)]
    np.testing.assert_allclose(found, 1.5**2)


def test_an_approaching_car_may_be_the_front_of_a_truck():
    """The variance matches a mixture in which one vehicle in three is a truck with its middle 3 m
    further back."""
    added = unobserved_length_of_kinds().covariance(at([-20.0, 0.0]), P, 3.0, CAR)
    rng = np.random.default_rng(0)
    is_truck = rng.random(400_000) < 1.0 / 3.0
    behind = is_truck * 0.5 * (9.0 + 3.0 * rng.standard_normal(len(is_truck)) - 3.0)
    assert added[0, 0] == pytest.approx(np.square(behind).mean(), rel=0.02)
    assert not added[1].any() and not added[:, 1].any()


@pytest.mark.parametrize('heading', [0.0, 2.0, np.pi])
def test_a_car_is_certain_once_a_truck_would_have_been_sensed(heading):
    unobserved_length, forward = unobserved_length_of_kinds(), np.array(
        [np.cos(heading), np.sin(heading)])
    for beyond, is_uncertain in ((-9.0, True), (2.9, True), (3.1, False), (8.0, False)):
        x = at(beyond * forward, heading)
        unobserved_length.update(x, P, np.zeros((1, 3)), True)
        assert unobserved_length.covariance(x, P, 3.0, CAR).any() == is_uncertain


def test_the_distance_along_the_path_counts_around_a_corner():
    unobserved_length = unobserved_length_of_kinds()
    for position, heading, is_uncertain in (([-4.0, 1.0], 0.0, True), ([1.0, 1.0], 0.0, True),
                                            ([2.0, 0.0], -1.5, True), ([2.0, -2.0], -1.5, False)):
        x = at(position, heading)
        unobserved_length.update(x, P, np.zeros((1, 3)), True)
        assert unobserved_length.covariance(x, P, 3.0, CAR).any() == is_uncertain


def test_only_a_sensor_near_the_path_confirms_the_length():
    unobserved_length, far = unobserved_length_of_kinds(), np.array(
        [[-100.0, 500.0, 0.0], [0.0, 3.0, 0.0]])
    unobserved_length.update(at([-20.0, 0.0]), P, far, True)
    assert unobserved_length.covariance(at([-20.0, 0.0]), P, 3.0, CAR).any()
    for positions, is_certain in ((np.zeros((0, 3)), True), (far, False)):
        # No sensor measured the vehicle, or its position is ambiguous.
        unobserved_length.update(at([20.0, 0.0]), P, positions, is_certain)
        assert unobserved_length.covariance(at([20.0, 0.0]), P, 3.0, CAR).any()


def test_a_vehicle_that_stops_keeps_its_heading():
    unobserved_length = unobserved_length_of_kinds()
    unobserved_length.update(at([-5.0, 0.0]), P, SENSORS, True)
    moving = unobserved_length.covariance(at([-4.0, 0.0]), P, 3.0, CAR)
    for heading in (0.0, 2.0, 4.0):
        standing = at([-4.0, 0.0], heading, 0.1)
        unobserved_length.update(standing, P, SENSORS, True)
        np.testing.assert_allclose(unobserved_length.covariance(standing, P, 3.0, CAR), moving)


def test_no_vehicle_is_longer_than_the_longest_kind():
    coming, cars = at([-20.0, 0.0]), UnobservedLength([3.0], [1.0])
    for length in (2.0, 3.0, 4.0):
        assert not cars.covariance(coming, P, length, 0).any()
    longest = [UnobservedLength(lengths, [3.0] * len(lengths)).covariance(coming, P, 8.9, -1)
               for lengths in ([9.0], [0.0, 3.0, 9.0])]
    # Shorter kinds do not change the result for the longest kind.
    np.testing.assert_array_equal(*longest)


def test_the_difference_to_another_path_widens_the_joint_covariance():
    """The difference widens position, velocity and heading of a smoothed pose. The joint covariance
    stays positive semidefinite."""
    model, x = RowVehicle(np.zeros(3), np.ones(3)), at([0.0, 0.0], 0.5 * np.pi)
    found = {}
    for name, difference in (('here', np.zeros(6)), ('apart', np.array([6.0, 0, 0, 2.0, 0, 0]))):
        found[name] = smoothed_pose(
            model, VehicleOrientation(), x, P, unobserved_length=None, difference=difference,
            stamp_ns=0, id=1, kind=0, kinds=('car',), ambiguous=False, complete=True)
    here, apart = found['here'], found['apart']
    assert apart.covariance[0, 0] == pytest.approx(36.0)
    assert here.covariance[0, 0] < 36.0
    assert apart.covariance[3, 3] > here.covariance[3, 3]
    assert apart.orientation_covariance[2, 2] > here.orientation_covariance[2, 2]
    whole = np.block([
        [apart.covariance[:3, :3], apart.position_orientation_covariance],
        [apart.position_orientation_covariance.T, apart.orientation_covariance]])
    assert np.linalg.eigvalsh(whole)[0] > -1e-9
    np.testing.assert_allclose(apart.covariance[1, 1], here.covariance[1, 1])
