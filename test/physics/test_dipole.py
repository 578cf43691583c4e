"""Dipole field and Jacobians: magnetostatics, invariances, and comparison with magpylib."""

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mag_tracking.physics.dipole import dipole_field, dipole_jacobians, sensor_fields

settings.register_profile('ci', derandomize=True, deadline=None, max_examples=60)
settings.load_profile('ci')

coordinate = st.floats(-5.0, 5.0)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
away = vector.filter(lambda v: np.linalg.norm(v) > 0.3)
moment = vector.filter(lambda v: np.linalg.norm(v) > 0.1)


@given(away, moment)
def test_field_has_neither_divergence_nor_curl(r, m):
    J, _ = dipole_jacobians(r, m)
    size = np.abs(J).max()
    assert abs(np.trace(J)) <= 1e-12 * size
    assert np.abs(J - J.T).max() <= 1e-12 * size


@given(away, moment, st.floats(0.5, 4.0))
def test_field_falls_with_the_cube_of_the_distance(r, m, u):
    near, far = dipole_field(r, m), dipole_field(u * r, m)
    np.testing.assert_allclose(far * u**3, near, rtol=1e-11, atol=1e-12 * np.linalg.norm(near))


@given(away, moment, vector)
def test_field_rotates_with_the_scene(r, m, axis):
    R = Rotation.from_rotvec(axis).as_matrix()
    B = dipole_field(r, m)
    np.testing.assert_allclose(dipole_field(R @ r, R @ m), R @ B, rtol=0,
                               atol=1e-12 * np.linalg.norm(B))


@given(away, moment, moment)
def test_fields_superpose(r, a, b):
    total = dipole_field(r, a + b)
    np.testing.assert_allclose(dipole_field(r, a) + dipole_field(r, b), total, rtol=0,
                               atol=1e-12 * (np.linalg.norm(a) + np.linalg.norm(b))
                               * 2e-7 / np.linalg.norm(r)**3)


@given(away, moment)
def test_jacobians_agree_with_differences(r, m):
    dB_dr, dB_dm = dipole_jacobians(r, m)
    h = 1e-5
    for k, e in enumerate(np.eye(3)):
        numeric = (dipole_field(r + h * e, m) - dipole_field(r - h * e, m)) / (2 * h)
        np.testing.assert_allclose(dB_dr[:, k], numeric, rtol=0, atol=2e-7 * np.abs(dB_dr).max())
        np.testing.assert_allclose(dB_dm[:, k], dipole_field(r, e), rtol=0,
                                   atol=1e-12 * np.abs(dB_dm).max())


def test_field_equals_magpylib():
    rng = np.random.default_rng(0)
    r, m = rng.uniform(-3, 3, (50, 3)), rng.standard_normal((50, 3))
    for ri, mi in zip(r, m, strict=True):
        expected = magpylib.misc.Dipole(moment=mi).getB(ri)
        np.testing.assert_allclose(dipole_field(ri, mi), expected, rtol=0,
                                   atol=1e-9 * np.linalg.norm(expected))


def test_singular_point_is_nan_and_does_not_affect_others():
    B = dipole_field(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), [0.0, 0.0, 1.0])
    assert np.isnan(B[0]).all()
    np.testing.assert_allclose(B[1], [0.0, 0.0, -1e-7])


def test_a_wrong_last_axis_is_rejected():
    with pytest.raises(ValueError, match='length 3'):
        dipole_field(np.zeros((4, 2)), np.zeros(2))


def test_read_only_arrays_are_accepted():
    r, m = np.ones((4, 3)), np.ones((4, 3))
    expected = dipole_field(r, m)
    r.flags.writeable = m.flags.writeable = False
    np.testing.assert_array_equal(dipole_field(r, m), expected)


def test_sensor_fields_sum_dipoles_and_rotate_to_the_sensor_frame():
    rng = np.random.default_rng(1)
    positions, R_sw = rng.uniform(-5, 5, (3, 3)), Rotation.random(3, random_state=2).as_matrix()
    r, m = rng.uniform(-1, 1, (4, 2, 3)), rng.standard_normal((4, 2, 3))
    dr, dm = rng.standard_normal((4, 2, 3, 5)), rng.standard_normal((4, 2, 3, 5))
    h, H, gradient = sensor_fields(positions, R_sw, r, m, dr, dm)
    d = positions[None, :, None] - r[:, None]
    world = dipole_field(d, m[:, None])
    np.testing.assert_allclose(h, np.einsum('jik,pjk->pji', R_sw, world.sum(axis=2)), rtol=1e-12)
    J_r, J_m = dipole_jacobians(d, m[:, None])
    expected = np.einsum('jik,pjskl,pslc->pjic', R_sw, J_m, dm) \
        - np.einsum('jik,pjskl,pslc->pjic', R_sw, J_r, dr)
    np.testing.assert_allclose(H, expected, rtol=1e-9, atol=1e-12 * np.abs(H).max())
    size = 1e-7 * np.linalg.norm(m, axis=2)[:, None] / np.linalg.norm(d, axis=3) ** 4
    np.testing.assert_allclose(gradient, size.sum(axis=2), rtol=1e-10)
