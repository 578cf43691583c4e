"""Speed and heading, compared with random samples of a velocity, and overlap of bodies."""

import numpy as np
import pytest

from mag_tracking.geometry import heading_of, overlap, speed_of

V = np.array([6.0, -8.0, 0.5])
P = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.03]])


def test_standard_deviations_match_random_samples():
    samples = np.random.default_rng(0).multivariate_normal(V, P, 400_000)
    speed, heading = speed_of(V, P), heading_of(V, P)
    assert speed == pytest.approx((np.linalg.norm(V), np.linalg.norm(samples, axis=1).std()),
                                  rel=0.01)
    assert heading == pytest.approx((np.arctan2(-8.0, 6.0),
                                     np.arctan2(samples[:, 1], samples[:, 0]).std()), rel=0.01)
    assert heading_of(V[:2], P[:2, :2]) == heading


@pytest.mark.filterwarnings('error')
def test_the_heading_is_unknown_at_rest():
    assert speed_of(np.zeros(2), np.diag([0.04, 0.09])) == pytest.approx((0.0, 0.3))
    assert heading_of(np.zeros(3), P) == (0.0, np.inf)


def test_bodies_overlap_along_the_heading_of_the_second_but_not_across_it():
    """The second body moves left. The first is, in turn, behind, beside, ahead of and near it."""
    position = np.array([[[2.0, 0.0], [0.0, 2.0], [-2.0, 0.1], [0.5, -1.0]], np.zeros((4, 2))])
    velocity = np.array([np.tile([9.0, 0.0], (4, 1)), np.tile([-9.0, 0.0], (4, 1))])
    np.testing.assert_allclose(overlap(position, velocity, 5.0, 1.5), [3.0, 0.0, 3.0, 4.5])
    np.testing.assert_array_equal(overlap(position, velocity, 2.0, 1.5) > 0.0, [0, 0, 0, 1])
