"""Permeable ellipsoid: comparison with integrals, limiting cases, corrected MITRE12 equations."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from mag_tracking.physics.dipole import MU0
from mag_tracking.physics.vehicles import demagnetisation_factors, ellipsoid_moment

settings.register_profile('ci', derandomize=True, deadline=None, max_examples=60)
settings.load_profile('ci')

aspect = st.floats(-3.0, 3.0).map(lambda x: 10.0**x)
semi_axis = st.floats(0.1, 10.0)
permeability = st.floats(1.0, 1e4)
angle = st.floats(-10.0, 10.0)
induction = st.tuples(*3 * [st.floats(-60e-6, 60e-6)]).map(np.array)


def integrated_factor(a, b, c):
    """Demagnetisation factor along a, by numerical integration.

    a b c/2 int_0^inf ds/((s + a^2) sqrt((s + a^2)(s + b^2)(s + c^2))), with s = exp(u).
    """
    def integrand(u):
        s = math.exp(u)
        return s / ((s + a * a) * math.sqrt((s + a * a) * (s + b * b) * (s + c * c)))
    ends = sorted({2 * math.log(a), 2 * math.log(b), 2 * math.log(c)})
    places = [ends[0] - 80, *ends, ends[-1] + 80]
    parts = [quad(integrand, lo, hi, epsabs=0, epsrel=1e-12, limit=200)[0]
             for lo, hi in zip(places, places[1:], strict=False)]
    return 0.5 * a * b * c * sum(parts)


@given(aspect)
def test_factors_equal_the_integral(m):
    L1, L2 = demagnetisation_factors(m)
    np.testing.assert_allclose(L1, integrated_factor(m, 1.0, 1.0), rtol=1e-11)
    np.testing.assert_allclose(L2, integrated_factor(1.0, m, 1.0), rtol=1e-11)


@given(st.floats(-100.0, 100.0))
def test_factors_sum_to_one(exponent):
    L1, L2 = demagnetisation_factors(10.0**exponent)
    assert abs(L1 + 2 * L2 - 1) <= 1e-15


@given(st.floats(1.05, 50.0))
def test_factors_equal_the_corrected_published_ones(m):
    c = math.sqrt(m * m - 1)
    t1 = m / (2 * c) * math.log((m + c) / (m - c)) - 1
    L1, L2 = demagnetisation_factors(m)
    np.testing.assert_allclose(L1, t1 / c**2, rtol=1e-12)
    np.testing.assert_allclose(L2, (m - (t1 + 1) / m) * m / (2 * c**2), rtol=1e-12)


def test_factors_of_sphere_needle_and_disk_equal_their_limits():
    np.testing.assert_allclose(demagnetisation_factors(1.0), [1 / 3, 1 / 3], rtol=1e-15)
    # Near the sphere L1 = 1/3 - 4/15 (m - 1).
    np.testing.assert_allclose(demagnetisation_factors(1 + 1e-8)[0] - 1 / 3, -4e-8 / 15, rtol=1e-6)
    L1, L2 = demagnetisation_factors(1e6)
    np.testing.assert_allclose([L1, L2], [(math.log(2e6) - 1) * 1e-12, 0.5], rtol=1e-10)
    L1, L2 = demagnetisation_factors(1e-6)
    np.testing.assert_allclose([1 - L1, L2], [math.pi / 2 * 1e-6, math.pi / 4 * 1e-6], rtol=1e-5)


def test_factors_keep_the_shape():
    L1, L2 = demagnetisation_factors([[0.5, 1.0, 2.0]])
    assert L1.shape == L2.shape == (1, 3)
    assert L1[0, 0] > L1[0, 1] > L1[0, 2]


@pytest.mark.parametrize('aspect', [0.0, -2.0, math.nan, math.inf, [1.0, 0.0]])
def test_an_invalid_aspect_is_rejected(aspect):
    with pytest.raises(ValueError, match='aspect .*1e-100 and 1e100'):
        demagnetisation_factors(aspect)


@given(semi_axis, permeability, angle, induction)
def test_sphere_has_the_moment_of_t10(radius, mu_r, heading, B0):
    # T10 eq. (3.33)
    volume = 4 / 3 * math.pi * radius**3
    expected = 3 * volume / MU0 * (mu_r - 1) / (mu_r + 2) * B0
    np.testing.assert_allclose(ellipsoid_moment((radius, radius), mu_r, heading, B0), expected,
                               rtol=0, atol=1e-13 * np.abs(expected).max())


@given(semi_axis, semi_axis, permeability, angle, angle, induction)
def test_moment_rotates_with_the_scene(a, b, mu_r, heading, turn, B0):
    R = Rotation.from_euler('z', turn).as_matrix()
    m = ellipsoid_moment((a, b), mu_r, heading, B0)
    rotated = ellipsoid_moment((a, b), mu_r, heading + turn, R @ B0)
    # Reversing the heading does not change the body, and the response is linear in the field.
    back = ellipsoid_moment((a, b), mu_r, heading + math.pi, 2 * B0)
    # The maximum replaces the norm, because the squares of a tiny induction underflow to zero.
    limit = 1e-12 * 4 / 3 * math.pi * a * b * b * mu_r * np.abs(B0).max() / MU0
    np.testing.assert_allclose(rotated, R @ m, rtol=0, atol=limit)
    np.testing.assert_allclose(back, 2 * m, rtol=0, atol=limit)


@given(semi_axis, semi_axis, st.floats(1.0, 1e4), angle)
def test_moment_along_and_across_the_axis(a, b, mu_r, heading):
    volume, kappa = 4 / 3 * math.pi * a * b * b, mu_r - 1
    axis = np.array([math.cos(heading), math.sin(heading), 0.0])
    for B0, L in ((50e-6 * axis, integrated_factor(a, b, b)),
                  (np.array([0.0, 0.0, -50e-6]), integrated_factor(b, a, b))):
        # M = kappa H inside, and H inside is B0/mu0 - L M.
        M = ellipsoid_moment((a, b), mu_r, heading, B0) / volume
        np.testing.assert_allclose(M, kappa * (B0 / MU0 - L * M), rtol=0,
                                   atol=1e-10 * kappa * 40.0)


def test_moment_equals_the_published_one_in_vehicle_axes():
    # MITRE12 table 1: a light vehicle in Tucson; eq. (A.1)-(A.7), course 30 degrees from north.
    a, b, kappa, B0 = 2.0, 1.0, 10.0, 57e-6
    course, inclination, declination = np.deg2rad([30.0, 59.0, -11.0])
    east = B0 * math.sin(declination) * math.cos(inclination)
    north = B0 * math.cos(declination) * math.cos(inclination)
    down = B0 * math.sin(inclination)
    s, c = math.sin(course), math.cos(course)
    H = np.array([s * east + c * north, -c * east + s * north, down]) / MU0
    L1, L2 = integrated_factor(a, b, b), integrated_factor(b, a, b)
    P = np.array([kappa / (1 + kappa * L1), kappa / (1 + kappa * L2), kappa / (1 + kappa * L2)])
    M = 4 * math.pi * a * b * b / 3 * P * H
    m = ellipsoid_moment((a, b), 1 + kappa, math.pi / 2 - course, [east, north, -down])
    np.testing.assert_allclose([m @ [s, c, 0], m @ [-c, s, 0], -m[2]], M, rtol=1e-10)
    # The published factor, with B0 in microtesla, equals B0/mu0.
    np.testing.assert_allclose(2.5 * 57 / math.pi, B0 / MU0, rtol=1e-12)


def test_moment_broadcasts():
    headings, B0 = np.linspace(0, 3, 4), np.array([1e-6, 2e-5, -4e-5])
    m = ellipsoid_moment((2.0, 0.8), 50.0, headings, B0)
    assert m.shape == (4, 3)
    np.testing.assert_array_equal(m[2], ellipsoid_moment((2.0, 0.8), 50.0, headings[2], B0))
    np.testing.assert_array_equal(ellipsoid_moment((2.0, 0.8), 1.0, headings, B0), 0.0)


def test_invalid_arguments_raise_value_error():
    B0 = np.array([0.0, 2e-5, -4e-5])
    for semi_axes in ((0.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (1.0, math.inf)):
        with pytest.raises(ValueError, match='semi_axes'):
            ellipsoid_moment(semi_axes, 10.0, 0.0, B0)
    for mu_r in (0.99, math.nan, math.inf):
        with pytest.raises(ValueError, match=f'mu_r .*{mu_r}'):
            ellipsoid_moment((2.0, 1.0), mu_r, 0.0, B0)
    with pytest.raises(ValueError, match=r'length 3.*\(2,\)'):
        ellipsoid_moment((2.0, 1.0), 10.0, 0.0, B0[:2])
