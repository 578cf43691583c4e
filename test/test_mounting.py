"""Sensors turned from what the network says: derivatives, and what it does to a track."""

import numpy as np
import pytest
from conftest import line_network
from test_track import drive

from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from mag_tracking.io.simulator import Imperfections, Path, point_body
from mag_tracking.physics.mounting import turned_fields


def case():
    rng = np.random.default_rng(4)
    return (rng.standard_normal((5, 3, 3)), rng.standard_normal((5, 3, 3, 4)),
            0.2 * rng.standard_normal((5, 3, 3)))


def test_no_angle_changes_nothing():
    h, H, angles = case()
    turned, derivative = turned_fields(h, H, 0.0 * angles)
    np.testing.assert_array_equal(turned, h)
    np.testing.assert_array_equal(derivative[..., :4], H)


def test_small_angles_are_a_rotation_to_first_order():
    h, H, angles = case()
    for scale in (1e-1, 1e-2, 1e-3):
        R = rotation_from_quaternion(quaternion_from_rotation_vector(scale * angles))
        turned, derivative = turned_fields(h, H, scale * angles)
        worst = np.linalg.norm(turned - (R @ h[..., None])[..., 0], axis=-1)
        limit = 0.5 * (scale * np.linalg.norm(angles, axis=-1)) ** 2
        assert (worst <= 1.01 * limit * np.linalg.norm(h, axis=-1)).all()
        assert (np.linalg.norm(derivative[..., :4] - R @ H, axis=-2)
                <= 1.01 * limit[..., None] * np.linalg.norm(H, axis=-2)).all()


def test_derivatives_by_state_and_angle():
    """The field is a linear function of a state here, so that H is its derivative."""
    h, H, angles = case()

    def field(v):
        return turned_fields(h + (H @ v[:4]), H, (v[4:].reshape(3, 3) + angles))[0]

    v = np.zeros(4 + 9)
    derivative = turned_fields(h, H, angles)[1]
    for k in range(len(v)):
        e = 1e-6 * np.eye(len(v))[k]
        expected = (field(v + e) - field(v - e)) / 2e-6
        if k < 4:
            np.testing.assert_allclose(derivative[..., k], expected, atol=1e-8)
            continue
        # The angles of one sensor, and what the others see of them: nothing.
        j, a = divmod(k - 4, 3)
        np.testing.assert_allclose(derivative[:, j, :, 4 + a], expected[:, j], atol=1e-8)
        assert not np.delete(expected, j, axis=1).any()


@pytest.fixture(scope='module')
def passes():
    """{mounting_std_deg: (mean NEES, RMS error [m])} of passes by sensors turned by 5 degrees."""
    network = line_network(2, tilt=0.0)
    out = {}
    for mounting in (0.0, 5.0):
        nees, squares = [], []
        for seed in range(8):
            side = 1.2 if seed % 2 else -1.2
            tracks, _, truth = drive(
                network, point_body([300.0, -150.0, 80.0], 5.0, 0.5),
                Path(np.array([-70.0, side]), 0.0, 10.0), seed=seed,
                changes={'track.mounting_std_deg': mounting, 'track.field_error': 0.02,
                         'track.near_field_length': 0.0},
                flaws=Imperfections(bias_std=1e-6, tilt_std=np.deg2rad(5.0)))
            live = [t for t in tracks if not t.ended]
            for t, q in zip(live, truth, strict=True):
                if np.hypot(*q) < 5.0:
                    e = t.position[:2] - q
                    nees.append(e @ np.linalg.solve(t.covariance[:2, :2], e) / 2)
                    squares.append(e @ e)
        out[mounting] = float(np.mean(nees)), float(np.sqrt(np.mean(squares)))
    return out


def test_estimated_mounting_makes_the_covariance_honest(passes):
    print(passes)
    assert passes[5.0][0] < 2.0
    assert passes[5.0][0] < 0.5 * passes[0.0][0]
    assert passes[5.0][1] < passes[0.0][1]
