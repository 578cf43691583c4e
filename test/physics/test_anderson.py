"""Anderson functions: comparison with the dipole field of a straight pass, and CPA."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.physics.passes import anderson_residual, closest_approach

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
def test_the_functions_and_a_constant_describe_a_dipole_exactly(one_pass, m):
    r0, v0 = one_pass
    t_cpa, distance, _ = closest_approach(r0, v0)
    scale = distance / np.linalg.norm(v0)
    t = t_cpa + np.linspace(-10, 10, 41) * scale
    B = dipole_field(-(r0 + t[:, None] * v0), m)
    y = B / np.abs(B).max() + [1.0, -2.0, 3.0]
    assert abs(anderson_residual(t, y, t_cpa, scale)) < 1e-12 * np.sum(y**2)
    assert anderson_residual(t, y, t_cpa, 1.3 * scale) > 1e-6 * np.sum(np.var(y, axis=0))


def test_the_residual_equals_that_of_least_squares():
    rng = np.random.default_rng(2)
    t, y = rng.uniform(-3.0, 3.0, 30), rng.standard_normal((30, 2))
    tau = (t - 0.4) / 0.7
    A = np.stack([np.ones(30), *(tau**n / (tau**2 + 1.0)**2.5 for n in range(3))], axis=1)
    expected = np.linalg.lstsq(A, y, rcond=None)[1].sum()
    np.testing.assert_allclose(anderson_residual(t, y, 0.4, 0.7), expected, rtol=1e-12)


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


@given(velocity, st.floats(0.01, 100.0), st.sampled_from([-1.0, 1.0]))
def test_a_pass_through_the_sensor_has_range_zero(v0, factor, sign):
    time, distance, r_cpa = closest_approach(sign * factor * v0, v0)
    np.testing.assert_allclose(time, -sign * factor, rtol=1e-14)
    assert distance == 0.0 and not r_cpa.any()


def test_a_velocity_without_direction_is_rejected():
    for v in ([0.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0]):
        with pytest.raises(ValueError, match='v0'):
            closest_approach([-3.0, 1.0, 0.0], v)
