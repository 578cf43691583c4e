"""Likelihood ratio of two lanes: sign, scale, and driving directions in the traffic of PHD15."""

import numpy as np
import pytest

from mag_tracking.physics.dipole import dipole_field
from support.direction_likelihood import (
    LaneHypothesis,
    direction_likelihood_ratio,
)
from support.two_way_traffic import far_sensor_error, passings, shares

RIGHT, LEFT = LaneHypothesis(25.0, 3.5), LaneHypothesis(-25.0, 6.5)
T = np.arange(-0.75, 0.75, 0.01)


def passing_field(rng, lane):
    """Horizontal field (n, 2) [T] at the sensor while a random dipole passes in a lane."""
    r = np.stack([lane.speed * (T - rng.uniform(-0.1, 0.1)), np.full(len(T), lane.distance),
                  np.full(len(T), lane.height)], axis=1)
    return dipole_field(-r, 400.0 * rng.standard_normal(3))[:, :2]


@pytest.mark.parametrize('height', [0.0, 0.6])
def test_sign_of_the_ratio_identifies_the_lane_of_a_dipole(height):
    rng = np.random.default_rng(0)
    right_lane, left_lane = RIGHT._replace(height=height), LEFT._replace(height=height)
    for _ in range(30):
        for lane, sign in ((right_lane, 1.0), (left_lane, -1.0)):
            h = passing_field(rng, lane)
            noisy = h + 1e-8 * rng.standard_normal(h.shape)
            assert sign * direction_likelihood_ratio(T, noisy, 1e-8, right_lane, left_lane) > 0.0


def test_ratio_is_proportional_to_the_signal_to_noise_power_ratio():
    """Without noise, the residual in the correct lane is zero."""
    rng = np.random.default_rng(1)
    h = passing_field(rng, RIGHT)
    ratios = [direction_likelihood_ratio(T, h, std, RIGHT, LEFT) for std in (2e-8, 1e-8)]
    assert ratios[1] == pytest.approx(4.0 * ratios[0], rel=1e-6)


@pytest.mark.study
@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
def test_directions_are_as_accurate_as_in_the_published_traffic(simulator):
    """In PHD15 Paper B, Table 1, 510 of 511 near-sensor and 494 fused directions are correct."""
    vehicles = passings(simulator, 1)
    fractions = shares(vehicles, [v.log_odds_of_north() for v in vehicles])
    # The limits are three standard deviations (511 vehicles) below the targets, 99.8 % and 97 %.
    # With the box simulator, the result is 99.5 % (`bench.directions`). In six of seven errors,
    # another vehicle is in the other lane within 0.62 s; in four of these errors, it is a truck.
    assert fractions.near > 0.998 - 3.0 * np.sqrt(0.998 * 0.002 / 511)
    assert fractions.fused > 0.97 - 3.0 * np.sqrt(0.97 * 0.03 / 511)
    predicted, measured = far_sensor_error(vehicles)
    assert abs(predicted - measured) < 0.05
