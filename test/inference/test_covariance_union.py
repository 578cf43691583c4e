"""Inflation of a covariance so that it covers another estimate."""

import numpy as np
import pytest

from mag_tracking.inference.covariances import inflated_to_cover


def test_a_covariance_is_inflated_just_enough_to_cover_a_difference():
    """The velocity covariance is inflated, too."""
    P = np.diag([1.0, 4.0, 9.0, 1.0, 1.0, 1.0, 100.0])
    difference = np.array([3.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    inflated = inflated_to_cover(P, difference)
    assert inflated[0, 0] == pytest.approx(9.0)
    assert inflated[0, 3] == pytest.approx(8.0 / 9.0 * 6.0)
    np.testing.assert_allclose(inflated[1:3, 1:3], P[1:3, 1:3])
    assert inflated[6, 6] == 100.0 and np.linalg.eigvalsh(inflated)[0] > 0.0
    for small in (np.zeros(6), 0.3 * difference, np.array([0.0, 1.9, 0.0, 9.0, 9.0, 0.0])):
        np.testing.assert_array_equal(inflated_to_cover(P, small), P)


def test_a_zero_difference_leaves_the_covariance_unchanged():
    P = np.full((6, 6), np.nan)
    assert inflated_to_cover(P, np.zeros(6)) is P
