"""Hard and soft iron from moments at several headings."""

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.inference.identification import hard_and_soft_iron
from mag_tracking.physics.dipole import MU0
from support.vehicle_5 import TABLE

H = np.array([2e-6, 1.55e-5, -4.9e-5]) / MU0
"""(3,) A/m, ambient field strength B0/mu0, world frame."""
HARD, SOFT = np.array([-200.0, 120.0, -270.0]), 4.0
EQUAL = np.tile(np.eye(3), (20, 1, 1))
"""Covariances (20, 3, 3) of moments with equal weights."""


def moments_at(headings):
    """Moments (n, 3) [A m^2] of a vehicle with the iron HARD and SOFT."""
    c, s = np.cos(headings), np.sin(headings)
    x, y, z = HARD
    return np.stack([c * x - s * y, s * x + c * y, z + 0.0 * c], axis=1) + SOFT * H


def test_fit_reproduces_the_published_iron():
    """The fit uses equal weights and 3 B0/mu0 as in T10 eq. (6.16); the published D is 1.23."""
    B0 = 1.7e-7 * np.array([0.0, 0.31, -0.95])
    fit = hard_and_soft_iron(TABLE[:, 1:4], np.deg2rad(TABLE[:, 0]), 3.0 * B0 / MU0,
                             EQUAL[:len(TABLE)])
    print(f'T10 Table 6.9: m0 = {fit.hard.round(3)}, D = {fit.soft:.3f}')
    np.testing.assert_allclose(fit.hard, [-0.47, 0.29, -0.56], atol=0.005)
    assert fit.soft == pytest.approx(1.22, abs=0.005)


def test_exact_moments_give_exact_iron():
    headings = np.deg2rad([0.0, 80.0, 200.0])
    fit = hard_and_soft_iron(moments_at(headings), headings, H, EQUAL[:3])
    np.testing.assert_allclose(fit.hard, HARD, rtol=1e-10)
    assert fit.soft == pytest.approx(SOFT, rel=1e-10)
    assert fit.normalised_cost < 1e-18


def test_covariance_agrees_with_the_errors():
    rng = np.random.default_rng(1)
    headings = np.deg2rad([10.0, 100.0, 190.0, 280.0] * 2)
    C = np.tile(np.diag([9.0, 16.0, 25.0]), (8, 1, 1))
    nees, costs = [], []
    for _ in range(400):
        noise = rng.standard_normal((8, 3)) * np.sqrt(np.diagonal(C[0]))
        fit = hard_and_soft_iron(moments_at(headings) + noise, headings, H, C)
        e = np.append(fit.hard - HARD, fit.soft - SOFT)
        nees.append(e @ np.linalg.solve(fit.covariance, e))
        costs.append(fit.normalised_cost)
    low, high = chi2.ppf([0.005, 0.995], 4 * 400) / 400
    assert low <= np.mean(nees) <= high
    assert np.mean(costs) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize('headings, field_strength', [
    ([0.3], H), ([0.3, 0.3, 0.3 + 2.0 * np.pi], H),
    ([0.3, 1.3, 2.3], [0.0, 0.0, -39.0]), ([0.3, 1.3, 2.3], np.zeros(3))])
def test_inseparable_hard_and_soft_iron_is_rejected(headings, field_strength):
    headings = np.array(headings)
    with pytest.raises(ValueError, match='separated'):
        hard_and_soft_iron(moments_at(headings), headings, field_strength, EQUAL[:len(headings)])


def test_invalid_arguments_raise_value_error():
    headings = np.array([0.0, 1.0, 2.0])
    m = moments_at(headings)
    with pytest.raises(ValueError, match='finite'):
        hard_and_soft_iron(m * [np.nan, 1.0, 1.0], headings, H, EQUAL[:3])
    with pytest.raises(ValueError, match='definite'):
        hard_and_soft_iron(m, headings, H, -np.tile(np.eye(3), (3, 1, 1)))
