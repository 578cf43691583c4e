"""Anderson expansion: comparison with the dipole field of a straight pass, and CPA."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.physics.passes import (
    anderson_coefficients,
    anderson_field,
    anderson_functions,
    closest_approach,
)

settings.register_profile('ci', derandomize=True, deadline=None, max_examples=60)
settings.load_profile('ci')

coordinate = st.floats(-20.0, 20.0)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
velocity = vector.filter(lambda v: np.linalg.norm(v) > 0.1)
moment = vector.filter(lambda v: np.linalg.norm(v) > 0.1)


def sine_between(a, b):
    return np.linalg.norm(np.cross(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b))


passes = st.tuples(vector.filter(lambda v: np.linalg.norm(v) > 0.3), velocity).filter(
    lambda p: sine_between(*p) > 0.02)


@given(passes, moment)
def test_expansion_equals_the_dipole(one_pass, m):
    r0, v0 = one_pass
    t_cpa, distance, _ = closest_approach(r0, v0)
    t = t_cpa + np.linspace(-10, 10, 41) * distance / np.linalg.norm(v0)
    expected = dipole_field(-(r0 + t[:, None] * v0), m)
    error = np.linalg.norm(anderson_field(t, r0, v0, m) - expected, axis=1)
    assert (error / np.linalg.norm(expected, axis=1)).max() < 1e-12


@given(passes, moment, vector)
def test_expansion_rotates_with_the_scene(one_pass, m, axis):
    r0, v0 = one_pass
    R = Rotation.from_rotvec(axis).as_matrix()
    B = anderson_field(0.1, r0, v0, m)
    np.testing.assert_allclose(anderson_field(0.1, R @ r0, R @ v0, R @ m), R @ B, rtol=0,
                               atol=1e-11 * np.linalg.norm(B))


@given(st.floats(-1e3, 1e3))
def test_functions_equal_the_corrected_published_ones(tau):
    expected = np.array([1.0, tau, tau * tau]) / (tau * tau + 1)**2.5
    np.testing.assert_allclose(anderson_functions(tau), expected, rtol=1e-13, atol=1e-300)


def test_functions_keep_the_shape_and_do_not_overflow():
    tau = np.array([[-1e200, -1.0, 0.0], [1.0, 2.0, 1e200]])
    f = anderson_functions(tau)
    assert f.shape == (2, 3, 3)
    np.testing.assert_array_equal(f[0, 2], [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(f[[0, 1], [0, 2]], 0.0)


def test_only_the_odd_function_is_orthogonal_to_the_others():
    def product(i, j):
        return quad(lambda t: anderson_functions(t)[i] * anderson_functions(t)[j],
                    -np.inf, np.inf)[0]
    assert abs(product(0, 1)) < 1e-12 and abs(product(1, 2)) < 1e-12
    np.testing.assert_allclose(product(0, 2), 5 * math.pi / 128, rtol=1e-8)


@given(passes, st.floats(-1.0, 1.0))
def test_no_point_of_the_pass_is_closer_than_the_cpa(one_pass, dt):
    r0, v0 = one_pass
    time, distance, r_cpa = closest_approach(r0, v0)
    size = np.linalg.norm(r0)
    np.testing.assert_allclose(r_cpa, r0 + time * v0, rtol=0, atol=1e-14 * size)
    np.testing.assert_allclose(distance, sine_between(r0, v0) * size, rtol=1e-12)
    assert abs(r_cpa @ v0) <= 1e-15 * distance * np.linalg.norm(v0)
    assert np.linalg.norm(r0 + (time + dt) * v0) >= distance * (1 - 1e-13)


def test_cpa_of_a_grazing_pass_is_perpendicular_to_the_velocity():
    # The rounding error of r0 along v0 is not small relative to the CPA range.
    rng = np.random.default_rng(0)
    for v0, sideways in rng.standard_normal((50, 2, 3)):
        r0 = 1000.0 * v0 + 1e-10 * sideways
        _, distance, r_cpa = closest_approach(r0, v0)
        assert 0.0 < distance < 1e-9
        assert abs(r_cpa @ v0) <= 1e-14 * distance * np.linalg.norm(v0)


def test_closest_approach_of_a_known_pass_is_exact():
    time, distance, r_cpa = closest_approach([-3.0, 1.0, 0.0], [1.5, 0.0, 0.0])
    assert (time, distance) == (2.0, 1.0)
    np.testing.assert_array_equal(r_cpa, [0.0, 1.0, 0.0])


@given(velocity, st.floats(0.01, 100.0), st.sampled_from([-1.0, 1.0]), moment)
def test_a_pass_through_the_sensor_has_range_zero_and_no_expansion(v0, factor, sign, m):
    time, distance, r_cpa = closest_approach(sign * factor * v0, v0)
    np.testing.assert_allclose(time, -sign * factor, rtol=1e-14)
    assert distance == 0.0 and not r_cpa.any()
    assert np.isnan(anderson_coefficients(r_cpa, v0, m)).all()
    B = anderson_field(np.zeros(4), sign * factor * v0, v0, m)
    assert B.shape == (4, 3) and np.isnan(B).all()


def test_coefficients_of_a_known_pass_are_exact():
    # Path along x at y = 2, moment along z: only the third row is not zero.
    C = anderson_coefficients([0.0, 2.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 8.0])
    np.testing.assert_allclose(C, [[0, 0, 0], [0, 0, 0], [-1e-7, 0, -1e-7]], rtol=0, atol=1e-22)
    # Moment along the path: the lateral component contains only the function of n = 1.
    C = anderson_coefficients([0.0, 2.0, 0.0], [3.0, 0.0, 0.0], [8.0, 0.0, 0.0])
    np.testing.assert_allclose(C, [[-1e-7, 0, 2e-7], [0, 3e-7, 0], [0, 0, 0]], rtol=0, atol=1e-22)


def test_invalid_arguments_raise_value_error():
    r0, v0, m = [-3.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    for v in ([0.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0]):
        with pytest.raises(ValueError, match='v0'):
            closest_approach(r0, v)
        with pytest.raises(ValueError, match='v0'):
            anderson_coefficients([0.0, 1.0, 0.0], v, m)
    with pytest.raises(ValueError, match='r_cpa .*perpendicular'):
        anderson_coefficients(r0, v0, m)
    with pytest.raises(ValueError, match=r'r0 .*\(1, 3\)'):
        closest_approach([r0], v0)
    with pytest.raises(ValueError, match=r'm .*\(2,\)'):
        anderson_field(0.0, r0, v0, m[:2])
