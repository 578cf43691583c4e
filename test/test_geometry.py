"""Speed and heading of a velocity, with deviations, against samples of it."""

import numpy as np
import pytest

from mag_tracking.geometry import heading_of, speed_of

V = np.array([6.0, -8.0, 0.5])
P = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.03]])


def test_deviations_are_those_of_samples():
    samples = np.random.default_rng(0).multivariate_normal(V, P, 400_000)
    speed, heading = speed_of(V, P), heading_of(V, P)
    assert speed == pytest.approx((np.linalg.norm(V), np.linalg.norm(samples, axis=1).std()),
                                  rel=0.01)
    assert heading == pytest.approx((np.arctan2(-8.0, 6.0),
                                     np.arctan2(samples[:, 1], samples[:, 0]).std()), rel=0.01)
    assert heading_of(V[:2], P[:2, :2]) == heading


@pytest.mark.filterwarnings('error')
def test_at_rest_there_is_no_heading():
    assert speed_of(np.zeros(2), np.diag([0.04, 0.09])) == pytest.approx((0.0, 0.3))
    assert heading_of(np.zeros(3), P) == (0.0, np.inf)
