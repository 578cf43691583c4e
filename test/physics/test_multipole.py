"""Multipole fields: magnetostatics, expansions of dipole clouds, and comparison with magpylib."""

import math
from itertools import permutations, product

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mag_tracking.physics.dipole import MU0, dipole_field, dipole_jacobians
from mag_tracking.physics.multipole import multipole_field, multipole_jacobians, multipole_moments

settings.register_profile('ci', derandomize=True, deadline=None, max_examples=60)
settings.load_profile('ci')

coordinate = st.floats(-5.0, 5.0)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
away = vector.filter(lambda v: np.linalg.norm(v) > 0.3)
moment = vector.filter(lambda v: np.linalg.norm(v) > 0.1)
component = st.floats(-1.0, 1.0)
moments15 = st.lists(component, min_size=15, max_size=15).map(np.array).filter(
    lambda m: np.linalg.norm(m) > 0.1)
seed = st.integers(0, 10**6)

PARTS = {1: slice(0, 3), 2: slice(3, 8), 3: slice(8, 15)}
COMPONENTS = {1: ('x', 'y', 'z'), 2: ('xx', 'xy', 'xz', 'yy', 'yz'),
              3: ('xxx', 'xxy', 'xxz', 'xyy', 'xyz', 'yyy', 'yyz')}


def single_order(order, moments):
    """Copy the moments and set those of all orders except `order` to zero."""
    out = np.zeros_like(moments)
    out[..., PARTS[order]] = moments[..., PARTS[order]]
    return out


def tensor(order, moments):
    """Convert the moments of one order to the full symmetric traceless tensor."""
    T = np.zeros((3,) * order)
    for name, value in zip(COMPONENTS[order], moments[PARTS[order]], strict=True):
        for axes in set(permutations(['xyz'.index(c) for c in name])):
            T[axes] = value
    for rest in product(range(3), repeat=order - 2) if order > 1 else ():
        trace = T[(*rest, 0, 0)] + T[(*rest, 1, 1)]
        for axes in set(permutations((*rest, 2, 2))):
            T[axes] = -trace
    return T


def published_field(r, order, moments):
    """Field of one order as published: T10 eq. (3.39) and (3.40)."""
    distance = np.linalg.norm(r)
    M = tensor(order, moments)
    for _ in range(order - 1):
        M = M @ r / distance
    M = M / math.factorial(order)
    return 1e-7 * ((2 * order + 1) * (r @ M) * r - order * distance**2 * M) / distance**(order + 4)


def cloud(n, size):
    """Random positions of `n` dipoles in a cube of edge length `size`, and their moments."""
    rng = np.random.default_rng(n)
    return rng.uniform(-0.5 * size, 0.5 * size, (n, 3)), rng.standard_normal((n, 3))


def relative_error(B, expected):
    return np.linalg.norm(B - expected, axis=-1) / np.linalg.norm(expected, axis=-1)


@given(away, moment)
def test_order_one_is_the_dipole(r, m):
    B = dipole_field(r, m)
    np.testing.assert_allclose(multipole_field(r, m), B, rtol=0, atol=1e-14 * np.linalg.norm(B))
    for J, expected in zip(multipole_jacobians(r, m), dipole_jacobians(r, m), strict=True):
        np.testing.assert_allclose(J, expected, rtol=0, atol=1e-14 * np.abs(expected).max())


@pytest.mark.parametrize('order', [1, 2, 3])
@given(r=away, moments=moments15)
def test_field_equals_the_published_one(order, r, moments):
    scale = 1e-7 * 15 / np.linalg.norm(r)**(order + 2)
    np.testing.assert_allclose(multipole_field(r, single_order(order, moments)),
                               published_field(r, order, moments), rtol=0, atol=1e-13 * scale)


@given(away, moments15)
def test_field_has_neither_divergence_nor_curl(r, moments):
    # One order at a time: far away, the sum would mask the octupole.
    for order in PARTS:
        J, _ = multipole_jacobians(r, single_order(order, moments))
        assert abs(np.trace(J)) <= 2e-12 * np.abs(J).max()
        assert np.abs(J - J.T).max() <= 1e-12 * np.abs(J).max()


@pytest.mark.parametrize('order', [1, 2, 3])
@given(r=away, moments=moments15, u=st.floats(0.5, 4.0))
def test_field_of_each_order_decays_with_its_power_of_the_distance(order, r, moments, u):
    near = multipole_field(r, single_order(order, moments))
    far = multipole_field(u * r, single_order(order, moments))
    scale = 1e-7 * np.abs(moments[PARTS[order]]).max() / np.linalg.norm(r)**(order + 2)
    np.testing.assert_allclose(far * u**(order + 2), near, rtol=0, atol=1e-12 * scale)


@given(away, vector, seed)
def test_field_rotates_with_the_scene(r, axis, seed):
    R = Rotation.from_rotvec(axis).as_matrix()
    rng = np.random.default_rng(seed)
    points, dipoles = rng.uniform(-1, 1, (4, 3)), rng.standard_normal((4, 3))
    moments = multipole_moments(points, dipoles, 3)
    rotated = multipole_moments(points @ R.T, dipoles @ R.T, 3)
    for order in PARTS:
        B = multipole_field(r, single_order(order, moments))
        scale = 1e-7 * np.abs(moments).max() / np.linalg.norm(r)**(order + 2)
        np.testing.assert_allclose(multipole_field(R @ r, single_order(order, rotated)), R @ B,
                                   rtol=0, atol=2e-12 * scale)


@pytest.mark.parametrize('order', [1, 2, 3])
@given(r=away, moments=moments15)
def test_jacobians_agree_with_differences(order, r, moments):
    # One order at a time, so that none masks another; the vector ends with that order.
    part = PARTS[order]
    moments = single_order(order, moments)[:part.stop]
    dB_dr, dB_dm = multipole_jacobians(r, moments)
    h = 1e-5 * np.linalg.norm(r)
    column = np.abs(dB_dm[:, part]).max()
    scale = np.abs(moments).max() * column
    for c, e in enumerate(np.eye(3)):
        numeric = (multipole_field(r + h * e, moments)
                   - multipole_field(r - h * e, moments)) / (2 * h)
        np.testing.assert_allclose(dB_dr[:, c], numeric, rtol=0,
                                   atol=1e-7 * scale / np.linalg.norm(r))
    for c, e in enumerate(np.eye(part.stop)[part], start=part.start):
        np.testing.assert_allclose(dB_dm[:, c], multipole_field(r, e), rtol=0, atol=1e-13 * column)
    np.testing.assert_allclose(dB_dm @ moments, multipole_field(r, moments), rtol=0,
                               atol=1e-12 * scale)


@given(away, vector, moment)
def test_orders_of_a_shifted_dipole_are_its_taylor_series(r, x, m):
    moments = multipole_moments(x[None], m[None], 3)
    gradient = dipole_jacobians(r, m)[0]
    np.testing.assert_allclose(multipole_field(r, single_order(2, moments)), -gradient @ x, rtol=0,
                               atol=1e-12 * np.abs(gradient).max() * (1 + np.linalg.norm(x)))
    h = 1e-4 * np.linalg.norm(r)
    size = max(np.linalg.norm(x), 1e-3)
    u = x / size
    second = (dipole_field(r + h * u, m) - 2 * dipole_field(r, m) + dipole_field(r - h * u, m))
    scale = np.linalg.norm(dipole_field(r, m)) * (size / np.linalg.norm(r))**2
    np.testing.assert_allclose(multipole_field(r, single_order(3, moments)),
                               0.5 * second * (size / h)**2, rtol=0, atol=3e-6 * scale)


@pytest.mark.parametrize('order', [1, 2, 3])
def test_expansion_of_a_cloud_converges_with_the_first_neglected_order(order):
    points, dipoles = cloud(20, 1.0)
    moments = multipole_moments(points, dipoles, order)
    directions = np.random.default_rng(1).standard_normal((30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def error(distance):
        r = distance * directions
        exact = dipole_field(r[:, None] - points, dipoles).sum(axis=1)
        return np.sqrt(np.mean((multipole_field(r, moments) - exact)**2))

    # Up to order 1, 2 or 3, the error decreases with power 4, 5 or 6 of the distance.
    measured = np.log2(error(20.0) / error(40.0))
    assert abs(measured - (order + 3)) < 0.05


def test_expansion_of_a_cuboid_magnet_equals_magpylib():
    # Two Gauss points per axis are exact for all moments up to order 4.
    sides, polarization = np.array([0.03, 0.02, 0.05]), np.array([0.3, -0.5, 1.1])
    magnet = magpylib.magnet.Cuboid(dimension=sides, polarization=polarization)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    m = polarization / MU0 * sides.prod()
    moments = multipole_moments(corners * sides / (2 * math.sqrt(3)), np.tile(m / 8, (8, 1)), 3)
    np.testing.assert_allclose(moments[:3], m, rtol=1e-14)
    r = 0.3 * np.random.default_rng(3).standard_normal((40, 3))
    r = r[np.linalg.norm(r, axis=1) > 0.3]
    expected = magnet.getB(r)
    assert relative_error(multipole_field(r, moments[:3]), expected).max() > 1e-3
    # Order 5 is the first neglected order: (size/distance)^4.
    assert relative_error(multipole_field(r, moments), expected).max() < 1e-4


def test_singular_point_is_nan_and_does_not_affect_others():
    r = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    moments = np.arange(1.0, 16.0)
    B, (dB_dr, dB_dm) = multipole_field(r, moments), multipole_jacobians(r, moments)
    for values in (B, dB_dr, dB_dm):
        assert np.isnan(values[0]).all()
        assert np.isfinite(values[1]).all()


def test_shapes_broadcast_and_read_only_arrays_are_accepted():
    r = np.broadcast_to([1.0, 2.0, 3.0], (4, 1, 3))
    moments = np.random.default_rng(0).standard_normal((5, 8))
    assert multipole_field(r, moments).shape == (4, 5, 3)
    dB_dr, dB_dm = multipole_jacobians(r, moments)
    assert dB_dr.shape == (4, 5, 3, 3) and dB_dm.shape == (4, 5, 3, 8)
    np.testing.assert_array_equal(multipole_field(r, moments)[3, 4],
                                  multipole_field([1.0, 2.0, 3.0], moments[4]))
    points, dipoles = np.random.default_rng(0).standard_normal((2, 6, 7, 3))
    batch = multipole_moments(points, dipoles, 3)
    assert batch.shape == (6, 15)
    np.testing.assert_array_equal(batch[5], multipole_moments(points[5], dipoles[5], 3))
    np.testing.assert_array_equal(batch[:, :8], multipole_moments(points, dipoles, 2))


def test_invalid_arguments_raise_value_error():
    with pytest.raises(ValueError, match='r .*length 3'):
        multipole_field(np.zeros((4, 2)), np.zeros(3))
    with pytest.raises(ValueError, match=r'3, 8 or 15, got shape \(5,\)'):
        multipole_field(np.ones(3), np.zeros(5))
    with pytest.raises(ValueError, match='1, 2 or 3, got 4'):
        multipole_moments(np.zeros((1, 3)), np.zeros((1, 3)), 4)
    with pytest.raises(ValueError, match=r'\(\.\.\., n, 3\)'):
        multipole_moments(np.zeros(3), np.zeros(3), 1)
