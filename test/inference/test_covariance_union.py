"""Covariances that cover another estimate, too."""

import numpy as np
import pytest

from mag_tracking.inference.covariance_union import inflated_to_cover


def test_a_covariance_is_widened_until_it_covers_a_difference_and_no_further():
    """The velocity is widened along with it."""
    P = np.diag([1.0, 4.0, 9.0, 1.0, 1.0, 1.0, 100.0])
    difference = np.array([3.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    wider = inflated_to_cover(P, difference)
    assert wider[0, 0] == pytest.approx(9.0)
    assert wider[0, 3] == pytest.approx(8.0 / 9.0 * 6.0)
    np.testing.assert_allclose(wider[1:3, 1:3], P[1:3, 1:3])
    assert wider[6, 6] == 100.0 and np.linalg.eigvalsh(wider)[0] > 0.0
    for little in (np.zeros(6), 0.3 * difference, np.array([0.0, 1.9, 0.0, 9.0, 9.0, 0.0])):
        np.testing.assert_array_equal(inflated_to_cover(P, little), P)


def test_without_a_difference_a_covariance_stays_what_it_is():
    P = np.full((6, 6), np.nan)
    assert inflated_to_cover(P, np.zeros(6)) is P
