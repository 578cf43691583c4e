"""Speed and direction from delays between sensors: accuracy, invariances and rejected data."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.analysis.correlated_motion import (
    CorrelatedMotion,
    contradicts_delays,
    correlated_motion,
)
from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from support.passes import NOISE, measured, network_of

HEIGHT = 0.5


def simulated_pass(speed, offset=2.0, seed=0, positions=((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
                   heading=0.0, noise=NOISE, n_dipoles=3):
    """Simulate a pass of a row of dipoles at the distance `offset` [m] from the origin."""
    rng = np.random.default_rng(seed)
    u = np.array([np.cos(heading), np.sin(heading), 0.0])
    path = np.concatenate([[-offset * u[1], offset * u[0], HEIGHT], speed * u, [3.0]])
    moments = 130.0 * rng.standard_normal((n_dipoles, 3))
    return measured(network_of(positions), path, moments, rng, rate=200.0, seconds=6.0, noise=noise)


@pytest.mark.parametrize('speed', [2.0, 8.0, 25.0])
@pytest.mark.parametrize('heading', [0.0, np.pi])
def test_the_delay_is_distance_over_speed(speed, heading):
    motion = correlated_motion(simulated_pass(speed, heading=heading))
    assert not motion.reason and motion.similarity > 0.99 and np.isnan(motion.heading_std)
    assert abs(motion.speed - speed) < max(3.0 * motion.speed_std, 1e-3 * speed)
    assert motion.speed_std < 0.05 * speed
    assert np.cos(motion.heading - heading) > 0.999
    (pair,) = motion.pairs
    assert pair.delay == pytest.approx(2.0 / speed * np.cos(heading), rel=0.02)


def test_sensors_may_have_different_orientations():
    data = simulated_pass(7.0)
    rotations = rotation_from_quaternion(quaternion_from_rotation_vector(
        np.array([[0.3, 1.0, -0.5], [2.0, 0.1, 0.4]])))
    field = np.einsum('nji,nj->ni', rotations[data.sensor], data.field)
    rotated = dataclasses.replace(data, network=dataclasses.replace(data.network, R_ws=rotations),
                                  field=field)
    assert correlated_motion(rotated).speed == pytest.approx(7.0, rel=0.01)


def test_small_orientation_and_gain_errors_have_little_effect():
    data = simulated_pass(7.0)
    rotation = rotation_from_quaternion(
        quaternion_from_rotation_vector(np.radians([1.5, -1.0, 2.0])))
    second = (data.sensor == 1)[:, None]
    field = np.where(second, 1.02 * data.field @ rotation, data.field)
    motion = correlated_motion(dataclasses.replace(data, field=field))
    assert abs(motion.speed - 7.0) < max(3.0 * motion.speed_std, 0.05)


def test_three_sensors_off_a_line_observe_the_heading():
    """The target is far away, so all pairs of sensors measure similar fields."""
    positions = ((-2.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.6, 0.0))
    motion = correlated_motion(simulated_pass(6.0, offset=25.0, positions=positions, noise=1e-12))
    assert not motion.reason and len(motion.pairs) == 3 and 0.0 < motion.heading_std < 0.5
    assert abs(np.angle(np.exp(1j * motion.heading))) < max(3.0 * motion.heading_std, 0.05)


def test_sensors_on_opposite_sides_of_a_road_have_no_delay():
    positions = ((0.0, -4.5, 0.0), (0.0, 4.5, 0.0))
    motion = correlated_motion(simulated_pass(9.0, offset=1.5, positions=positions))
    assert 'different fields' in motion.reason and np.isnan(motion.speed)


def test_sensors_side_by_side_have_no_delay():
    """A distant target passes both sensors at the same time."""
    positions = ((0.0, -0.25, 0.0), (0.0, 0.25, 0.0))
    motion = correlated_motion(simulated_pass(9.0, offset=20.0, positions=positions, noise=1e-11))
    assert 'same time' in motion.reason


def test_one_sensor_or_no_common_axis_results_in_a_reason():
    data = simulated_pass(9.0)
    field = data.field.copy()
    field[data.sensor == 0] = np.nan
    assert correlated_motion(dataclasses.replace(data, field=field)).reason.startswith('one sensor')
    field = data.field.copy()
    field[data.sensor == 0, 0] = field[data.sensor == 1, 1:] = np.nan
    motion = correlated_motion(dataclasses.replace(data, field=field))
    assert 'common axis' in motion.reason


def test_one_common_axis_is_sufficient():
    data = simulated_pass(9.0)
    field = data.field.copy()
    field[:, :2] = np.nan
    assert correlated_motion(dataclasses.replace(data, field=field)).speed == pytest.approx(
        9.0, rel=0.02)


def test_contradictions_depend_on_speed_heading_and_their_stds():
    c = CorrelatedMotion('', 10.0, 0.2, 0.0, np.nan, 1.0)
    straight_heading = 0.1, 0.02
    assert not contradicts_delays((10.4, 0.1), straight_heading, c) \
        and contradicts_delays((14.0, 0.3), straight_heading, c)
    assert contradicts_delays((10.0, 0.1), (np.pi, 0.1), c)
    # Speeds do not contradict each other if their difference is small or its std is large.
    assert not contradicts_delays((14.0, 2.0), straight_heading, c) \
        and not contradicts_delays((10.9, 0.01), straight_heading, c)
    assert not contradicts_delays((10.0, 0.1), (np.radians(100.0), np.radians(40.0)), c)
    # The delay is shorter on a path oblique to the line of the sensors.
    assert not contradicts_delays((10.0 * np.cos(0.5), 0.1), (0.5, 0.02), c)
    assert contradicts_delays((10.0, 0.1), (0.5, 0.02), c)
    off_line = CorrelatedMotion('', 10.0, 0.2, 0.0, 0.1, 1.0)
    assert not contradicts_delays((10.0, 0.1), (0.5, 0.02), off_line)
    for unknown in (CorrelatedMotion('one sensor'), CorrelatedMotion()):
        assert not contradicts_delays((14.0, 0.1), straight_heading, unknown)
    assert not contradicts_delays((np.nan, 0.1), straight_heading, c)


@pytest.mark.parametrize('positions', [((0.0, 0.0, 0.0), (0.0, 0.0, 0.6)),
                                       ((0.0, 0.0, 0.0), (0.04, 0.0, 0.6))])
def test_sensors_above_one_another_have_no_delay(positions):
    data = simulated_pass(9.0, positions=positions)
    clock_offset = np.where(data.sensor == 1, 0.03, 0.0)
    motion = correlated_motion(dataclasses.replace(data, t=data.t + clock_offset))
    assert 'no pair' in motion.reason


@pytest.mark.parametrize('fault', ['first sensor constant', 'all zero', 'one infinite',
                                   'equal timestamps', 'few', 'no noise'])
@pytest.mark.filterwarnings('error')
def test_faulty_readings_result_in_a_reason_or_an_estimate(fault):
    data = simulated_pass(9.0)
    field, t = data.field.copy(), data.t.copy()
    if fault == 'first sensor constant':
        field[data.sensor == 0] = 1e-6
    if fault == 'all zero':
        field[:] = 0.0
    if fault == 'one infinite':
        field[100, 0] = np.inf
    if fault == 'equal timestamps':
        for j in (0, 1):
            rows = np.flatnonzero(data.sensor == j)
            t[rows[100:900]] = t[rows[100]]
    faulty = dataclasses.replace(data, field=field, t=t)
    if fault == 'few':
        rows = np.flatnonzero(data.t > 2.98)
        faulty = dataclasses.replace(data, t=t[rows], sensor=data.sensor[rows], field=field[rows],
                                     covariance=data.covariance[rows])
    if fault == 'no noise':
        faulty = dataclasses.replace(data, covariance=0.0 * data.covariance)
    motion = correlated_motion(faulty)
    assert motion.reason if fault != 'one infinite' else abs(motion.speed - 9.0) < 0.3


@pytest.mark.parametrize('scale', [0.9, 0.5, 0.2])
def test_simultaneous_opposite_vehicles_have_no_delay(scale):
    one, other = simulated_pass(10.0, seed=1), simulated_pass(14.0, seed=2, heading=np.pi)
    both = dataclasses.replace(one, field=one.field + scale * other.field)
    assert 'different fields' in correlated_motion(both).reason


def test_missing_readings_have_no_effect():
    """Missing readings and their covariances are NaN in the log of a track."""
    data = simulated_pass(7.0)
    field, covariance = data.field.copy(), data.covariance.copy()
    field[[5, 1500]] = covariance[[5, 1500]] = np.nan
    motion = correlated_motion(dataclasses.replace(data, field=field, covariance=covariance))
    assert motion.speed == pytest.approx(7.0, rel=0.01)


def test_a_scaled_or_rotated_field_is_different():
    """A vehicle that turns away has a weaker and rotated field at the second sensor."""
    data = simulated_pass(7.0)
    second = (data.sensor == 1)[:, None]
    rotation = rotation_from_quaternion(
        quaternion_from_rotation_vector(np.radians([0.0, 0.0, 15.0])))
    for changed in (0.6 * data.field, data.field @ rotation):
        field = np.where(second, changed, data.field)
        assert 'different' in correlated_motion(dataclasses.replace(data, field=field)).reason
