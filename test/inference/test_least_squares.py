"""Non-linear least squares: divergent starts, infinite models and priors."""

import warnings

import numpy as np
from scipy.optimize import least_squares

from mag_tracking.inference.least_squares import SeparableProblem, project_out_linear, refine


class ExponentialModel:
    """Model p exp(theta t), which overflows beyond theta t = 709."""

    t = np.linspace(0.5, 1.0, 8)

    def basis(self, theta):
        with np.errstate(over='ignore'):
            return np.exp(theta[:, :1] * self.t)[:, :, None]

    def derivative(self, theta, p):
        return self.t[:, None] * self.basis(theta) * p[:, None]


def test_a_divergent_start_has_infinite_cost_and_does_not_affect_others():
    y = 2.0 * np.exp(3.0 * ExponentialModel.t)
    problem = SeparableProblem(ExponentialModel(), y)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        x, cost, _, _ = refine(problem.residual_and_jacobian, [[1e6], [2.5], [600.0], [np.nan]])
    assert np.isinf(cost[[0, 3]]).all()
    np.testing.assert_allclose(x[1], 3.0, rtol=1e-6)
    assert np.isinf(problem.cost(np.array([[1e6]])))


def test_an_infinite_model_has_no_linear_solution():
    A = np.stack([np.eye(3)[:, :2], np.full((3, 2), np.inf)])
    with np.errstate(invalid='ignore'):
        p, _, inverse = project_out_linear(A, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(p[0], [1.0, 2.0])
    assert np.isnan(inverse[1]).all()


class SineModel:
    """Model a sin(f t) + b cos(f t), with theta = (f, unused phase)."""

    t = np.linspace(0.0, 3.0, 40)

    def basis(self, theta):
        a = theta[:, :1] * self.t
        return np.stack([np.sin(a), np.cos(a)], axis=2)

    def derivative(self, theta, p):
        a = theta[:, :1] * self.t
        derivative = self.t * (np.cos(a) * p[:, :1] - np.sin(a) * p[:, 1:])
        return np.stack([derivative, np.zeros_like(derivative)], axis=2)


def sinusoid(prior):
    y = np.sin(2.0 * SineModel.t) + 0.3 * np.random.default_rng(1).standard_normal(40)
    return SeparableProblem(SineModel(), y, prior=prior)


def test_a_prior_has_the_weight_of_a_measurement():
    """The estimate equals the maximum a posteriori estimate by scipy for all unknowns jointly."""
    mean, std = np.array([2.4, 0.7]), np.array([0.05, 0.2])
    problem, y = sinusoid((mean, std)), np.sin(2.0 * SineModel.t) + 0.3 * np.random.default_rng(
        1).standard_normal(40)
    x, cost, P, converged = refine(problem.residual_and_jacobian, mean[None] + 0.1)

    def residual(u):
        f, phase, a, b = u
        return np.concatenate([y - a * np.sin(f * SineModel.t) - b * np.cos(f * SineModel.t),
                               (mean - [f, phase]) / std])

    expected = least_squares(residual, [2.4, 0.7, 1.0, 0.0], xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(x[0], expected.x[:2], rtol=1e-5)
    assert converged[0] and np.isclose(cost[0], 2.0 * expected.cost)
    np.testing.assert_allclose(problem.cost(x), cost)
    # A parameter that is not measured retains its prior.
    assert np.isclose(x[0, 1], 0.7) and np.isclose(P[0, 1, 1], 0.2**2)
    covariance = np.linalg.inv(expected.jac.T @ expected.jac)
    np.testing.assert_allclose(P[0, 0, 0], covariance[0, 0], rtol=1e-4)


def test_a_prior_of_infinite_std_has_no_effect():
    without_prior, with_prior = sinusoid(None), sinusoid((np.array([9.0, 9.0]), np.full(2, np.inf)))
    theta = np.array([[2.1, 0.0], [1.7, 3.0]])
    np.testing.assert_array_equal(without_prior.cost(theta), with_prior.cost(theta))
    for a, b in zip(without_prior.residual_and_jacobian(theta),
                    with_prior.residual_and_jacobian(theta), strict=True):
        np.testing.assert_array_equal(a, b)
