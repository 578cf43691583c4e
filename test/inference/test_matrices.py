"""Pseudo-inverses compared with NumPy."""

import numpy as np
import pytest

from mag_tracking.inference.matrices import pseudo_inverse


def information(k, rank, rng, n=5):
    """Symmetric matrices (n, k, k) of a given rank, with units that differ by decades."""
    A = rng.standard_normal((n, k, rank)) * 10.0**rng.uniform(-6.0, 6.0, (k, 1))
    return A @ np.swapaxes(A, 1, 2)


def numpy_pseudo_inverse(A):
    """Pseudo-inverse by NumPy, computed for unit diagonal and scaled back."""
    scale = np.sqrt(np.diagonal(A))
    return np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-11, hermitian=True) / np.outer(
        scale, scale)


@pytest.mark.parametrize('k, missing', [(1, 0), (2, 0), (7, 0), (15, 0), (2, 1), (7, 1), (15, 2)])
def test_pseudo_inverse_equals_that_of_numpy(k, missing):
    rng = np.random.default_rng(k)
    A = information(k, k + 20, rng)
    if missing:
        A[2] = information(k, k - missing, rng, 1)
    inverses = pseudo_inverse(A, 1e-11)
    for one, inverse in zip(A, inverses, strict=True):
        scale = np.sqrt(np.diagonal(one))
        np.testing.assert_allclose(inverse * np.outer(scale, scale),
                                   numpy_pseudo_inverse(one) * np.outer(scale, scale), atol=1e-9)
        np.testing.assert_allclose(inverse, inverse.T, rtol=1e-9)


def test_a_matrix_that_is_not_finite_yields_nan_and_does_not_affect_others():
    A = information(4, 9, np.random.default_rng(0), 3)
    alone = pseudo_inverse(A)
    for invalid in (np.nan, np.inf):
        A[1, 2, 2] = invalid
        inverses = pseudo_inverse(A)
        assert np.isnan(inverses[1]).all()
        np.testing.assert_allclose(inverses[[0, 2]], alone[[0, 2]], rtol=1e-7)


def test_zero_rows_stay_zero_in_the_pseudo_inverse():
    A = np.zeros((1, 3, 3))
    A[0, 0, 0] = 4.0
    np.testing.assert_array_equal(pseudo_inverse(A)[0], np.diag([0.25, 0.0, 0.0]))


def test_a_nearly_singular_matrix_is_treated_as_singular():
    A = np.array([[[1.0, 1.0], [1.0, 1.0 + 1e-14]]])
    np.testing.assert_allclose(pseudo_inverse(A, 1e-11), np.full((1, 2, 2), 0.25), rtol=1e-6)
