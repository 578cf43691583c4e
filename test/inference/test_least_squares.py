"""Searches that run away."""

import warnings

import numpy as np

from mag_tracking.inference.least_squares import SeparableProblem, project_out_linear, refine


class Grows:
    """basis exp(theta) of one number: infinite beyond 709."""

    t = np.linspace(0.5, 1.0, 8)

    def basis(self, theta):
        with np.errstate(over='ignore'):
            return np.exp(theta[:, :1] * self.t)[:, :, None]

    def derivative(self, theta, p):
        return self.t[:, None] * self.basis(theta) * p[:, None]


def test_a_start_that_is_no_number_costs_infinity_and_the_others_are_found():
    y = 2.0 * np.exp(3.0 * Grows.t)
    problem = SeparableProblem(Grows(), y)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        x, cost, _, _ = refine(problem.residual_and_jacobian, [[1e6], [2.5], [600.0], [np.nan]])
    assert np.isinf(cost[[0, 3]]).all()
    np.testing.assert_allclose(x[1], 3.0, rtol=1e-6)
    assert np.isinf(problem.cost(np.array([[1e6]])))


def test_a_model_that_is_infinite_has_no_linear_part():
    A = np.stack([np.eye(3)[:, :2], np.full((3, 2), np.inf)])
    with np.errstate(invalid='ignore'):
        p, _, inverse = project_out_linear(A, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(p[0], [1.0, 2.0])
    assert np.isnan(inverse[1]).all()
