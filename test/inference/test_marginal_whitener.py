"""Linear terms that are taken out of measurements, against the whole covariance."""

import numpy as np
import pytest

from mag_tracking.inference.marginal_whitener import MarginalWhitener


@pytest.mark.parametrize('n, q', [(12, 3), (6, 6), (5, 9)])
def test_it_whitens_what_the_terms_make_of_the_noise(n, q):
    rng = np.random.default_rng(n)
    C = rng.standard_normal((n, q)) * rng.lognormal(0.0, 2.0, q)
    y, A = rng.standard_normal(n), rng.standard_normal((2, n, 4))
    S, without = np.eye(n) + C @ C.T, MarginalWhitener(C)
    W = without(np.eye(n))
    np.testing.assert_allclose(W @ S @ W.T, np.eye(n), atol=1e-9)
    assert without(y) @ without(y) == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-9)
    np.testing.assert_allclose(without(A), np.einsum('ij,pjk->pik', W, A), atol=1e-9)
    F, G = (without.correction_factor(B) for B in A)
    np.testing.assert_allclose(A[0].T @ A[1] - F.T @ G, A[0].T @ np.linalg.solve(S, A[1]),
                               atol=1e-9)


def test_terms_of_nothing_change_nothing():
    y = np.arange(4.0)
    np.testing.assert_allclose(MarginalWhitener(np.zeros((4, 2)))(y), y)
