"""Marginalisation of linear terms of measurements, compared with the full covariance."""

import numpy as np
import pytest

from mag_tracking.inference.matrices import MarginalWhitener


@pytest.mark.parametrize('n, q', [(12, 3), (6, 6), (5, 9)])
def test_whitener_whitens_noise_plus_linear_terms(n, q):
    rng = np.random.default_rng(n)
    C = rng.standard_normal((n, q)) * rng.lognormal(0.0, 2.0, q)
    y, A = rng.standard_normal(n), rng.standard_normal((2, n, 4))
    S, whitener = np.eye(n) + C @ C.T, MarginalWhitener(C)
    W = whitener(np.eye(n))
    np.testing.assert_allclose(W @ S @ W.T, np.eye(n), atol=1e-9)
    assert whitener(y) @ whitener(y) == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-9)
    np.testing.assert_allclose(whitener(A), np.einsum('ij,pjk->pik', W, A), atol=1e-9)
    F, G = (whitener.correction_factor(B) for B in A)
    np.testing.assert_allclose(A[0].T @ A[1] - F.T @ G, A[0].T @ np.linalg.solve(S, A[1]),
                               atol=1e-9)


def test_zero_terms_have_no_effect():
    y = np.arange(4.0)
    np.testing.assert_allclose(MarginalWhitener(np.zeros((4, 2)))(y), y)
