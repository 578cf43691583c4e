"""Speed and heading of a velocity, against samples of it; bodies in each other."""

import numpy as np
import pytest

from mag_tracking.geometry import heading_of, overlap, speed_of

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


def test_bodies_overlap_along_the_way_of_the_second_and_beside_it_they_do_not():
    """Two metres behind, beside and ahead of one that goes to the left."""
    place = np.array([[[2.0, 0.0], [0.0, 2.0], [-2.0, 0.1], [0.5, -1.0]], np.zeros((4, 2))])
    velocity = np.array([np.tile([9.0, 0.0], (4, 1)), np.tile([-9.0, 0.0], (4, 1))])
    np.testing.assert_allclose(overlap(place, velocity, 5.0, 1.5), [3.0, 0.0, 3.0, 4.5])
    np.testing.assert_array_equal(overlap(place, velocity, 2.0, 1.5) > 0.0, [0, 0, 0, 1])
