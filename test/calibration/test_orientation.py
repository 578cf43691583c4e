"""Tilt and heading: invariances, consistent standard deviations, and unobservable headings."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from mag_tracking.calibration.orientation import (
    GRAVITY,
    MAX_RIVAL_COST,
    Orientation,
    UpDirection,
    compass_orientation,
    levelled,
    pooled_bias_std,
    up_direction,
    with_nominal_heading,
)
from mag_tracking.geometry import quaternion_from_rotation, rotation_about_z, yaw_between

EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])
UP = np.array([0.0, 0.0, 1.0])
BIAS = 6e-7

POSTURES = {'upright': np.eye(3), 'upside down': Rotation.from_euler('x', 180.0, True).as_matrix(),
            'on its side': Rotation.from_euler('x', 90.0, True).as_matrix(),
            'on its front': Rotation.from_euler('y', -90.0, True).as_matrix(),
            'askew': Rotation.from_euler('zyx', [130.0, 40.0, -70.0], True).as_matrix()}


def up_of(R_ws, std=0.0):
    """`UpDirection` of a sensor with orientation `R_ws`."""
    return UpDirection(R_ws.T @ UP, std)


def angles_between(R, S):
    """Rotation vector (3,) [rad], world frame, of the rotation from R to S."""
    return Rotation.from_matrix(S @ R.T).as_rotvec()


def at_rest(R_ws, n=200, noise=0.02, seed=0, bias=0.0):
    """Accelerations (n, 3) [m/s^2] of a sensor at rest."""
    rng = np.random.default_rng(seed)
    return GRAVITY * R_ws.T @ UP + bias + noise * rng.standard_normal((n, 3))


rotations = st.integers(0, 2**31).map(lambda s: Rotation.random(random_state=s).as_matrix())


@settings(max_examples=40, derandomize=True, deadline=None)
@given(rotations)
def test_up_direction_rotates_with_the_sensor(R):
    a = at_rest(np.eye(3))
    up, rotated = up_direction(a, 0.05), up_direction(a @ R, 0.05)
    np.testing.assert_allclose(rotated.direction, R.T @ up.direction, atol=2e-3)
    exact = up_direction(at_rest(R, noise=0.0), 0.05)
    np.testing.assert_allclose(exact.direction, R.T @ UP, atol=1e-12)
    assert exact.std == pytest.approx(0.05 / GRAVITY)


def test_knocks_and_readings_that_are_not_finite_are_excluded():
    a = at_rest(np.eye(3))
    expected = up_direction(a, 0.0)
    a[50:60] += [30.0, -20.0, 10.0]
    a[70], a[71, 1] = np.nan, np.inf
    up = up_direction(a, 0.0)
    assert np.arccos(up.direction @ expected.direction) < 1e-3
    # An accelerometer with coarse steps has no scatter at rest.
    coarse = np.tile([0.0, 0.0, GRAVITY], (50, 1))
    coarse[20] += [0.0, 5.0, 0.0]
    np.testing.assert_array_equal(up_direction(coarse, 0.0).direction, [0.0, 0.0, 1.0])


@pytest.mark.parametrize('a, message', [
    (np.zeros((0, 3)), '8 valid accelerations, got 0'),
    (at_rest(np.eye(3), 7), '8 valid accelerations, got 7'),
    (np.full((50, 3), np.nan), '8 valid accelerations, got 0'),
    (at_rest(np.eye(3)) / GRAVITY, r'unit g\?'),
    (np.zeros((50, 3)), '0, not 9.81'),
    (1.2 * at_rest(np.eye(3)), '11.8, not 9.81')])
def test_readings_other_than_gravity_at_rest_are_rejected(a, message):
    with pytest.raises(ValueError, match=message):
        up_direction(a, 0.05)


def test_tilt_error_agrees_with_its_std(n=400):
    rng = np.random.default_rng(1)
    squares = []
    for k in range(n):
        R = Rotation.random(random_state=k).as_matrix()
        up = up_direction(at_rest(R, 20, 0.1, k, 0.05 * rng.standard_normal(3)), 0.05)
        error = np.cross(R @ up.direction, UP)[:2]
        squares.append(error @ error / up.std**2)
    low, high = chi2.ppf([0.001, 0.999], 2 * n)
    # With 20 readings, the scatter is known to one sixth; it is one seventh of the variance.
    assert 0.9 * low < np.sum(squares) < 1.1 * high


@pytest.mark.parametrize('posture', POSTURES)
@pytest.mark.parametrize('yaw', [0.0, 37.0, 90.0, 180.0, -120.0])
def test_without_bias_the_orientation_is_exact(posture, yaw):
    R = rotation_about_z(np.deg2rad(yaw)) @ POSTURES[posture]
    found = compass_orientation(up_of(R), R.T @ EARTH, EARTH, BIAS)
    np.testing.assert_allclose(angles_between(found.R_ws, R), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.bias, 0.0, atol=1e-14)
    assert np.isnan(found.rival)
    level = np.hypot(*EARTH[:2])
    np.testing.assert_allclose(found.std, [0.0, 0.0, BIAS / level], rtol=1e-9)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(rotations, rotations)
def test_orientation_rotates_with_the_sensor(R, S):
    """A rotation of the readings by S only rotates the orientation and the bias."""
    rng = np.random.default_rng(0)
    y, up = R.T @ EARTH + BIAS * rng.standard_normal(3), up_of(R, 5e-3)
    a = compass_orientation(up, y, EARTH, BIAS)
    b = compass_orientation(UpDirection(S.T @ up.direction, 5e-3), S.T @ y, EARTH,
                            BIAS)
    np.testing.assert_allclose(angles_between(b.R_ws, a.R_ws @ S), 0.0, atol=1e-8)
    np.testing.assert_allclose(b.std, a.std, rtol=1e-6)
    np.testing.assert_allclose(b.bias, S.T @ a.bias, atol=1e-13)
    # The measured up direction stays vertical.
    np.testing.assert_allclose(a.R_ws @ up.direction, UP, atol=1e-12)


def test_orientation_rotates_with_the_world():
    y = EARTH + [3e-7, -5e-7, 1e-7]
    a = compass_orientation(up_of(np.eye(3)), y, EARTH, BIAS)
    for yaw in (0.7, -2.5):
        Rz = rotation_about_z(yaw)
        b = compass_orientation(up_of(np.eye(3)), y, Rz @ EARTH, BIAS)
        np.testing.assert_allclose(angles_between(b.R_ws, Rz @ a.R_ws), 0.0, atol=1e-8)


@pytest.mark.parametrize('lean, missing', [(0.3, None), (3.0, None), (0.3, 2), (3.0, 2)])
def test_heading_error_agrees_with_its_std(lean, missing, n=300):
    """The normalised errors of heading and tilt are chi-square distributed.

    Each simulated mounting has a random bias per axis and a random accelerometer error.
    """
    rng = np.random.default_rng(5)
    heading, tilt, n_gross = [], [], 0
    for k in range(n):
        R = rotation_about_z(rng.uniform(-np.pi, np.pi)) @ Rotation.from_rotvec(
            lean * rng.standard_normal(3)).as_matrix()
        up = up_direction(at_rest(R, 50, 0.02, k, 0.05 * rng.standard_normal(3)), 0.05)
        y = R.T @ EARTH + BIAS * rng.standard_normal(3)
        if missing is not None:
            y[missing] = np.nan
        try:
            found = compass_orientation(up, y, EARTH, BIAS)
        except ValueError:
            continue
        # With a missing horizontal axis, there are two headings or one uncertain heading.
        if not np.isnan(found.rival) or found.std[2] > np.deg2rad(5.0):
            continue
        error = angles_between(found.R_ws, R)
        if abs(error[2]) > 0.5:
            n_gross += 1
            continue
        # The tilts are a third of a degree, so the rotation vector has independent components.
        heading.append((error[2] / found.std[2])**2)
        tilt.append(np.sum((error[:2] / found.std[:2])**2))
    print(f'missing {missing}: heading {np.mean(heading):.3f}, tilt {np.mean(tilt) / 2:.3f}, '
          f'{len(heading)} of {n}')
    for squares, each in ((heading, 1), (tilt, 2)):
        low, high = chi2.ppf([0.001, 0.999], each * len(squares))
        assert low < np.sum(squares) < high
    assert len(heading) > (0.95 if missing is None or lean < 1.0 else 0.4) * n
    # The true heading is not reported if the cost of its bias exceeds MAX_RIVAL_COST.
    assert n_gross <= binom.ppf(0.999, n, chi2.sf(MAX_RIVAL_COST, 1)) * (missing is not None)


@pytest.mark.parametrize('posture', POSTURES)
def test_heading_error_without_bias_is_due_to_the_tilt_error(posture, n=200):
    """At a dip of 72 degrees, a tilt error causes a heading error three times as large."""
    rng, squares = np.random.default_rng(8), []
    for k in range(n):
        R = rotation_about_z(rng.uniform(-np.pi, np.pi)) @ POSTURES[posture]
        up = up_direction(at_rest(R, 50, 0.02, k, 0.05 * rng.standard_normal(3)), 0.05)
        found = compass_orientation(up, R.T @ EARTH, EARTH, 1e-9)
        squares.append((angles_between(found.R_ws, R)[2] / found.std[2])**2)
    assert found.std[2] == pytest.approx(49.0 / np.hypot(2.0, 15.5) * found.std[0], rel=1e-3)
    low, high = chi2.ppf([0.001, 0.999], n)
    assert low < np.sum(squares) < high


@pytest.mark.parametrize('earth', [[0.0, 0.0, -5e-5], [0.0, 0.0, 5e-5], [3e-7, 0.0, -5e-5],
                                   [0.0, 0.0, 0.0]])
def test_heading_is_not_observable_in_a_vertical_field(earth):
    with pytest.raises(ValueError, match='heading'):
        compass_orientation(up_of(np.eye(3)), np.array(earth), earth, BIAS)


def test_heading_is_not_observable_with_a_vertical_axis_alone():
    y = np.array([np.nan, np.nan, EARTH[2]])
    with pytest.raises(ValueError, match='heading'):
        compass_orientation(up_of(np.eye(3)), y, EARTH, BIAS)
    with pytest.raises(ValueError, match='heading'):
        compass_orientation(up_of(np.eye(3)), np.full(3, np.nan), EARTH, BIAS)


def test_a_vertical_axis_adds_no_information_to_two_horizontal_axes():
    R = rotation_about_z(0.4)
    y = R.T @ EARTH + [2e-7, 1e-7, 0.0]
    three = compass_orientation(up_of(R, 5e-3), y, EARTH, BIAS)
    two = compass_orientation(up_of(R, 5e-3), [*y[:2], np.nan], EARTH, BIAS)
    np.testing.assert_allclose(two.R_ws, three.R_ws, atol=1e-9)
    np.testing.assert_allclose(two.std, three.std)
    assert np.isnan(two.bias[2]) and not np.isnan(two.bias[:2]).any()


@pytest.mark.parametrize('yaw', [-140.0, -60.0, 25.0, 60.0, 120.0])
def test_a_single_horizontal_axis_has_a_rival(yaw):
    R = rotation_about_z(np.deg2rad(yaw))
    y = np.array([(R.T @ EARTH)[0], np.nan, np.nan])
    found = compass_orientation(up_of(R), y, EARTH, BIAS)
    # The axis may be on either side of the field.
    to_field = np.arctan2(EARTH[1], EARTH[0]) - np.deg2rad(yaw)
    other = np.deg2rad(yaw) + 2.0 * to_field
    headings = np.angle(np.exp(1j * np.array([np.deg2rad(yaw), other])))
    one = np.arctan2(found.R_ws[1, 0], found.R_ws[0, 0])
    k = int(np.abs(np.angle(np.exp(1j * (headings - one)))).argmin())
    assert one == pytest.approx(headings[k], abs=1e-6)
    rival = np.angle(np.exp(1j * (headings[1 - k] - one)))
    assert np.angle(np.exp(1j * (found.rival - rival))) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize('yaw', np.linspace(-180.0, 150.0, 12))
def test_sensors_with_two_horizontal_axes_have_no_rival(yaw):
    R = rotation_about_z(np.deg2rad(yaw))
    for missing_axes in ([], [2]):
        y = R.T @ EARTH + BIAS * np.array([1.0, -1.0, 0.5])
        y[missing_axes] = np.nan
        assert np.isnan(compass_orientation(up_of(R), y, EARTH, BIAS).rival)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(rotations, st.floats(-3.0, 3.0))
def test_yaw_between_is_the_rotation_about_the_vertical(R, yaw):
    assert yaw_between(R, rotation_about_z(yaw) @ R) == pytest.approx(yaw, abs=1e-9)
    assert yaw_between(rotation_about_z(yaw) @ R, R) == pytest.approx(-yaw, abs=1e-9)


def test_yaw_between_is_the_closest_rotation():
    R, S = Rotation.random(2, random_state=3).as_matrix()
    yaws = np.deg2rad(np.arange(-180.0, 180.0, 0.05))
    traces = [np.trace((rotation_about_z(a) @ R).T @ S) for a in yaws]
    assert yaw_between(R, S) == pytest.approx(yaws[int(np.argmax(traces))], abs=1e-3)


def heading_of(yaw_deg, std_deg, R=POSTURES['upright']):
    """`Orientation` with a heading and its std."""
    return Orientation(rotation_about_z(np.deg2rad(yaw_deg)) @ R,
                       np.deg2rad([0.3, 0.4, std_deg]), np.array([1e-7, 0.0, 0.0]), np.nan)


@pytest.mark.parametrize('compass, nominal, expected, std', [
    (2.0, 2.0, 3.0, np.sqrt(2.0)), (1.0, 3.0, 0.6, np.sqrt(0.9)), (3.0, 1.0, 5.4, np.sqrt(0.9)),
    (2.0, 180.0, 6.0 * 4.0 / 32404.0, 2.0)])
def test_headings_are_weighted_by_their_variances(compass, nominal, expected, std):
    R = POSTURES['askew']
    fused = with_nominal_heading(heading_of(0.0, compass, R), heading_of(6.0, 0.0, R).R_ws,
                                 np.deg2rad(nominal))
    assert np.degrees(yaw_between(R, fused.R_ws)) == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(np.degrees(fused.std), [0.3, 0.4, std], rtol=1e-3)
    # The tilt is measured by the accelerometer.
    np.testing.assert_allclose(fused.R_ws.T @ UP, R.T @ UP, atol=1e-12)
    assert fused.bias[0] == 1e-7


def test_an_inconsistent_nominal_heading_is_not_fused():
    def fused(difference):
        return with_nominal_heading(heading_of(0.0, 3.0), heading_of(difference, 0.0).R_ws,
                                    np.deg2rad(4.0))
    for sign in (1.0, -1.0):
        assert fused(14.9 * sign) is not None
        assert fused(15.1 * sign) is None
    assert fused(180.0) is None


def test_levelling_is_the_smallest_rotation_to_the_vertical():
    for posture in POSTURES.values():
        lean = Rotation.from_rotvec([0.05, -0.08, 0.0]).as_matrix()
        truth = lean @ posture
        found = levelled(up_of(truth, 5e-3), posture, np.deg2rad([5.0, 5.0, 4.0]))
        np.testing.assert_allclose(found.R_ws @ (truth.T @ UP), UP, atol=1e-12)
        rotation = angles_between(posture, found.R_ws)
        # The rotation is about a horizontal axis, by the tilt of the sensor.
        assert abs(rotation[2]) < 1e-12
        assert np.linalg.norm(rotation) == pytest.approx(np.hypot(0.05, 0.08), rel=1e-6)
        np.testing.assert_allclose(found.std, [5e-3, 5e-3, np.deg2rad(4.0)])
        assert np.isnan(found.bias).all() and np.isnan(found.rival)
    assert levelled(None, np.eye(3), np.ones(3)) is None


def biased(bias):
    return Orientation(np.eye(3), np.zeros(3), np.array(bias), np.nan)


def test_pooled_bias_counts_only_observed_components():
    assert pooled_bias_std([], BIAS) == pytest.approx(BIAS)
    one = pooled_bias_std([biased([0.0, 3e-7, 4e-7])], BIAS, 4.0)
    assert one == pytest.approx(np.sqrt((4.0 * BIAS**2 + 25e-14) / 6.0))
    two = pooled_bias_std([biased([0.0, 5e-7, np.nan])], BIAS, 4.0)
    assert two == pytest.approx(np.sqrt((4.0 * BIAS**2 + 25e-14) / 5.0))


def test_pooled_bias_std_of_many_sensors_is_the_true_std():
    rng, found = np.random.default_rng(2), []
    for k in range(200):
        R = Rotation.random(random_state=k).as_matrix()
        y = R.T @ EARTH + 1.5e-6 * rng.standard_normal(3)
        found.append(compass_orientation(up_of(R), y, EARTH, BIAS))
    low, high = np.sqrt(chi2.ppf([0.001, 0.999], 400) / 400)
    assert low < pooled_bias_std(found, 1.5e-6) / 1.5e-6 < high


def test_quaternion_from_rotation_is_the_same_rotation():
    R = Rotation.random(50, random_state=0).as_matrix()
    # For half turns, all but one component vanish.
    for M in [*R, *(Rotation.from_rotvec(np.pi * e).as_matrix() for e in np.eye(3)), np.eye(3)]:
        q = quaternion_from_rotation(M)
        assert np.linalg.norm(q) == pytest.approx(1.0)
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), M, atol=1e-12)
    np.testing.assert_allclose(rotation_about_z(0.3), Rotation.from_euler('z', 0.3).as_matrix())
