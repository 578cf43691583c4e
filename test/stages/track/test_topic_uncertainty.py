"""Covariance of ambiguous tracks in messages without an ambiguity flag."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mag_tracking.geometry import (
    quaternion_from_rotation_vector,
    quaternions_from_yaw,
    rotation_from_quaternion,
    rotation_vectors_between,
)
from mag_tracking.inference.covariances import second_moment
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.messages.schema import odometry_dict, pose_covariance, pose_message_dict
from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.stages.track.published_pose import VehicleOrientation, published_track
from mag_tracking.stages.track.settings import BEST, HOLD, MIXTURE
from support.random_passes import KINDS, SIMULATORS, one_random_pass

UNIT = st.floats(-1.0, 1.0)
VECTORS = st.tuples(UNIT, UNIT, UNIT).map(np.array)


def track_of(weights, positions, headings, policy=MIXTURE, std=0.5, **extra):
    """`Track` of a bank of points along x that move at 8 m/s; the first hypothesis is published."""
    n, model = len(positions), RowVehicle(np.zeros(3), np.ones(3), n_dipoles=1)
    x = np.zeros((n, 12))
    x[:, 0], x[:, 6] = positions, 100.0
    x[:, 3], x[:, 4] = 8.0 * np.cos(headings), 8.0 * np.sin(headings)
    bank = FilterBank(x, np.tile(std**2 * np.eye(12), (n, 1, 1)), np.log(weights), np.arange(n),
                      np.zeros(n, int), np.arange(n), np.ones((n, 2)))
    arguments = {'difference': np.zeros(6), 'stamp_ns': 10**9, 'id': 1, 'ended': False,
                 'existence': 1.0, 'degrees_of_freedom': 6, 'predicted': np.zeros((2, 3)),
                 'mounting': np.zeros((0, 3)), 'mounting_covariance': np.zeros((0, 3, 3))}
    return published_track(bank, 0, model, VehicleOrientation(), [f'{k}' for k in range(n)],
                           ('car',), set(), None, ambiguous_poses=policy, **{**arguments, **extra})


def test_the_covariance_of_the_mixture_matches_samples():
    """Position, heading and their correlation about the published pose are compared."""
    weights, positions, headings = [0.6, 0.3, 0.1], [0.0, 20.0, -9.0], [0.0, np.pi - 0.2, 0.3]
    track = track_of(weights, positions, headings)
    rng = np.random.default_rng(0)
    which = rng.choice(3, 400_000, p=weights)
    x = np.array(positions)[which] + 0.5 * rng.standard_normal(len(which))
    yaw = np.array(headings)[which] + 0.5 / 8.0 * rng.standard_normal(len(which))
    C = pose_covariance(track.topic_uncertainty)
    assert C[0, 0] == pytest.approx(np.square(x).mean(), rel=0.01)
    assert C[5, 5] == pytest.approx(np.square(yaw).mean(), rel=0.01)
    assert C[0, 5] == pytest.approx((x * yaw).mean(), rel=0.01)
    assert C[1, 1] == pytest.approx(0.25)
    assert np.linalg.eigvalsh(C).min() > 0.0
    # Pose and covariance of the track belong to a single hypothesis.
    assert track.position[0] == 0.0 and track.covariance[0, 0] == pytest.approx(0.25)


def test_the_mixture_is_never_narrower_than_the_pose():
    """This holds even if large innovations or the difference from another path widen the covariance
    of the pose."""
    for extra in ({}, {'excess': 7.0}, {'difference': np.array([3.0, 1.0, 0.0, 0.5, 0.0, 0.0])}):
        track = track_of([0.7, 0.3], [0.0, 15.0], [0.0, 3.0], **extra)
        wider = track.topic_uncertainty.covariance - track.covariance
        assert np.linalg.eigvalsh(wider).min() > -1e-9, extra
        assert wider[0, 0] > 0.3 * 14.0**2


@pytest.mark.parametrize('policy, weights, held, own', [
    (MIXTURE, [0.99, 0.01], False, True), (MIXTURE, [0.9, 0.1], False, False),
    (HOLD, [0.99, 0.01], False, True), (HOLD, [0.9, 0.1], True, False),
    (BEST, [0.99, 0.01], False, True), (BEST, [0.9, 0.1], False, True)])
def test_ambiguous_poses_are_published_according_to_the_policy(policy, weights, held, own):
    """An unambiguous track does not depend on the policy."""
    track = track_of(weights, [0.0, 30.0], [0.0, np.pi], policy)
    assert track.ambiguous == (weights[1] > 0.05)
    messages = pose_message_dict(track, 'map'), odometry_dict(track, 'map', 'track_1')
    assert [m is None for m in messages] == [held, held]
    if not held:
        covariance = np.array(messages[0]['pose']['covariance']).reshape(6, 6)
        assert np.array_equal(covariance, pose_covariance(track)) == own
        twist = np.array(messages[1]['twist']['covariance']).reshape(6, 6)
        assert (twist[0, 0] == pytest.approx(0.25)) == own


def test_the_second_moment_of_a_single_hypothesis_is_its_covariance():
    P = np.diag([1.0, 4.0])
    np.testing.assert_array_equal(second_moment(np.ones(1), np.zeros((1, 2)), P[None]), P)


@given(VECTORS, VECTORS)
def test_the_rotation_between_two_orientations_takes_one_to_the_other(a, b):
    q, other = quaternion_from_rotation_vector(3.0 * a), quaternion_from_rotation_vector(3.0 * b)
    v = rotation_vectors_between(q, np.stack([other, -other]))
    for row in v:
        R = rotation_from_quaternion(quaternion_from_rotation_vector(row))
        np.testing.assert_allclose(R @ rotation_from_quaternion(q),
                                   rotation_from_quaternion(other), atol=1e-9)
    assert (np.linalg.norm(v, axis=1) <= np.pi + 1e-9).all()


def test_the_rotation_between_two_headings_is_about_z():
    v = rotation_vectors_between(*quaternions_from_yaw(np.array([0.1, 2.9])))
    np.testing.assert_allclose(v, [0.0, 0.0, 2.8], atol=1e-12)
    np.testing.assert_array_equal(
        rotation_vectors_between(*quaternions_from_yaw(np.array([0.1, 0.1]))), np.zeros(3))


@pytest.mark.study
def test_ambiguous_poses_on_the_topics_are_consistent():
    """The ANEES on the topics is at most 2, over 102 random passes of two simulators."""
    found = [one_random_pass(s, k, seed) for seed in range(17) for s in SIMULATORS for k in KINDS]
    ambiguous = np.concatenate([f.ambiguous for f in found])
    nees = np.concatenate([f.topic_nees for f in found])
    plain = np.concatenate([f.nees for f in found])
    print(f'{ambiguous.sum()} ambiguous poses: ANEES {nees[ambiguous].mean():.2f} on the topics, '
          f'{plain[ambiguous].mean():.2f} of the pose alone')
    assert ambiguous.sum() > 500 and nees[ambiguous].mean() <= 2.0
    np.testing.assert_allclose(nees[~ambiguous], plain[~ambiguous], rtol=1e-12)


def test_a_record_without_topic_uncertainty_gives_no_messages():
    track = dataclasses.replace(track_of([1.0], [0.0], [0.0]), topic_uncertainty=None)
    assert pose_message_dict(track, 'map') is None and odometry_dict(track, 'map', 'x') is None
