"""Evidence of a track: doubts, reasons to end it, and the published covariance."""

from types import SimpleNamespace

import numpy as np
import pytest

from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.evidence import (
    CONTRADICTION,
    LOST,
    OVERFIT_NATS,
    UNEXPLAINED,
    UNEXPLAINED_S,
    TrackEvidence,
)
from mag_tracking.stages.track.published_pose import covariance_about
from mag_tracking.units import NS

SETTINGS = settings_for('vehicle').track


def pose(nis=6.0):
    return SimpleNamespace(nis=nis, degrees_of_freedom=6, stamp_ns=0)


def test_noise_contradicts_a_track_with_the_nominal_probability():
    rng = np.random.default_rng(0)
    nis = rng.chisquare(6, 3_000_000)
    n_doubtful = 0
    for value in nis[nis > 25.0]:
        evidence = TrackEvidence(2)
        evidence.contradicts(value * np.array([0.3, 0.7]), 6)
        n_doubtful += evidence.is_doubtful
    # The number of doubtful tracks has a Poisson distribution with mean 30.
    assert 10 < n_doubtful < 60 and len(nis) * CONTRADICTION == pytest.approx(30.0)


def test_a_track_that_was_contradicted_once_stays_doubtful():
    evidence = TrackEvidence(2)
    for nis in (6.0, 60.0, 6.0):
        assert evidence.contradicts(np.array([nis, 0.0]), 6) == (nis > 50.0)
    assert evidence.is_doubtful


def test_a_filter_that_overfits_is_flagged_for_the_duration_of_the_window():
    evidence = TrackEvidence(2)
    is_doubtful = []
    for t, loss in ((0.0, -9.0), (1.0, 0.9), (1.1, 1.1), (3.0, 0.0), (3.2, -9.0)):
        is_doubtful.append(evidence.update_filter_doubt(-loss * OVERFIT_NATS, round(t * NS), 2.0))
        reasons = {doubts.OVERFIT} if is_doubtful[-1] else {doubts.ANOTHER_PLACE}
        evidence.update_doubts(reasons, round(t * NS))
    assert is_doubtful == [False, False, True, True, False]
    # The doubt applies to single poses, not to the whole track.
    assert not evidence.is_doubtful
    # Smoothed poses at the same times are also doubtful.
    assert [evidence.was_filter_doubtful(round(t * NS)) for t in (1.0, 1.1, 3.0, 3.2)] == [
        False, True, True, False]


@pytest.mark.parametrize('nis, is_doubtful', [
    ([60.0, 1.0], True), ([60.0, 2.0, 1.0], False), ([60.0, np.nan, 1.0], False)])
def test_a_contradiction_flags_a_track_of_two_sensors_but_not_of_three(nis, is_doubtful):
    evidence = TrackEvidence(2)
    assert evidence.contradicts(np.array(nis), 3 * np.count_nonzero(~np.isnan(nis)))
    assert evidence.is_doubtful == is_doubtful


@pytest.mark.parametrize('nis, is_approaching, reason', [
    (6.0, False, 'out of reach'), (6.0, True, None), (1e4, False, LOST)])
def test_an_approaching_vehicle_is_not_out_of_reach(nis, is_approaching, reason):
    evidence = TrackEvidence(2)
    assert evidence.reason_to_end(pose(), 2.0, is_approaching, SETTINGS) is None
    assert evidence.reason_to_end(pose(nis), 7.0, is_approaching, SETTINGS) == reason


def bank_of(positions, weights, std=0.5, lengths=3.0):
    n, model = len(positions), RowVehicle(np.zeros(3), np.ones(3))
    n_t = len(model.state_names)
    x = np.zeros((n, n_t))
    x[:, 0], x[:, 3], x[:, n_t - 1] = positions, 8.0, lengths
    bank = FilterBank.from_targets(x, np.tile(std**2 * np.eye(n_t), (n, 1, 1)), np.zeros(n, int), 2,
                                   1e-8)
    bank.log_w = np.log(weights)
    return bank, model


def test_hypotheses_at_one_position_are_merged_in_the_covariance():
    """The covariance about the published hypothesis matches samples of the mixture."""
    bank, model = bank_of([0.0, 1.0, -0.5], [0.5, 0.3, 0.2])
    rng = np.random.default_rng(1)
    which = rng.choice(3, 400_000, p=[0.5, 0.3, 0.2])
    samples = bank.x[which, 0] + 0.5 * rng.standard_normal(len(which))
    assert covariance_about(bank, 0, model, bank.is_separated(0))[0, 0] == pytest.approx(
        np.square(samples).mean(), rel=0.01)


def test_hypotheses_at_other_positions_do_not_widen_the_covariance():
    bank, model = bank_of([0.0, 40.0], [0.9, 0.1])
    np.testing.assert_allclose(covariance_about(bank, 0, model, bank.is_separated(0)),
                               0.25 * np.eye(len(model.state_names)))
    assert bank.weight(bank.is_separated(0)) == pytest.approx(0.1)


def test_the_sign_of_the_row_length_does_not_widen_the_covariance():
    bank, model = bank_of([0.0, 0.0], [0.5, 0.5], lengths=np.array([3.0, -3.0]))
    assert covariance_about(bank, 0, model, bank.is_separated(0))[-1, -1] == pytest.approx(0.25)


def frame(field, noise=1e-8):
    field = np.array(field, dtype=float)
    return FieldFrame(0, field, np.tile(noise**2 * np.eye(3), (len(field), 1, 1)),
                      np.ones(len(field), dtype=int), np.zeros(len(field)))


def test_a_field_is_sensed_by_the_sensor_that_measures_it_and_noise_by_none():
    rng = np.random.default_rng(1)
    evidence = TrackEvidence(3)
    for _ in range(50):
        noise = 1e-8 * rng.standard_normal((2, 3))
        # The second sensor of the network is not used.
        evidence.add_frame(frame(noise + [[3e-8, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([0, 2]),
                           np.ones(2))
    assert evidence.sensed.tolist() == [True, False, False] and evidence.is_sensed_by_one
    assert evidence.largest[0] > 3e-8 and evidence.largest[1] == 0.0


def test_smoothed_poses_keep_doubts_about_misfits_but_not_about_arrivals():
    evidence = TrackEvidence(2)
    evidence.update_doubts({doubts.ANOTHER_ARRIVAL}, 1)
    evidence.update_doubts({doubts.DISTURBANCE_MODEL, doubts.ANOTHER_PLACE}, 2)
    assert [evidence.was_filter_doubtful(k) for k in (1, 2)] == [False, True]


def test_a_track_that_no_target_ever_explained_ends():
    def end_of(steps):
        evidence = TrackEvidence(2)
        for k in range(200):
            stamp = round(0.08 * k * NS)
            evidence.bayes_factor.add(steps(k), stamp, SETTINGS.min_bayes_factor)
            latest = pose()
            latest.stamp_ns = stamp
            reason = evidence.reason_to_end(latest, 1.0, False, SETTINGS)
            if reason:
                return reason, 0.08 * k
        return None

    reason, after_s = end_of(lambda k: -1.0)
    assert reason == UNEXPLAINED
    # The evidence takes three frames to fall by log(20).
    assert after_s == pytest.approx(UNEXPLAINED_S + 0.24, abs=0.17)
    assert end_of(lambda k: 1.0 if k < 5 else -1.0) is None
    # A track without a valid comparison is doubtful, but does not end.
    assert end_of(lambda k: np.nan) is None


def test_no_target_is_favoured_after_a_failed_comparison():
    bayes_factor = TrackEvidence(2).bayes_factor
    for k, value in enumerate([50.0, np.nan, 50.0]):
        bayes_factor.add(value, k, 20.0)
        assert bayes_factor.is_favoured(20.0) == (k == 0)


def test_a_recent_loss_of_evidence_is_forgotten_after_a_second():
    bayes_factor = TrackEvidence(2).bayes_factor
    bayes_factor.add(50.0, 0, 20.0)
    bayes_factor.add(-5.0, 2 * NS, 20.0)
    assert bayes_factor.is_favoured(20.0) and bayes_factor.is_recently_disfavoured(20.0)
    bayes_factor.add(0.0, round(3.1 * NS), 20.0)
    assert bayes_factor.is_favoured(20.0) and not bayes_factor.is_recently_disfavoured(20.0)


def test_published_doubts_are_ordered_and_have_meanings():
    names = [value for name, value in vars(doubts).items()
             if name.isupper() and isinstance(value, str)]
    assert sorted(names) == sorted(doubts.MEANINGS)
    assert doubts.ordered({doubts.HEIGHT, doubts.ANOTHER_PLACE}) == ('another_place', 'height')


def test_a_transient_doubt_persists_for_a_tenth_of_a_second():
    """Poses that would be unambiguous for only one frame are wrong more often than other poses."""
    evidence = TrackEvidence(2)
    assert evidence.update_doubts({doubts.HEIGHT, doubts.ANOTHER_PLACE}, NS) == \
        {doubts.HEIGHT, doubts.ANOTHER_PLACE}
    # Doubts that the bank can resolve from one frame to the next do not persist.
    assert evidence.update_doubts(set(), NS + round(0.08 * NS)) == {doubts.HEIGHT}
    assert evidence.update_doubts({doubts.OVERFIT}, NS + round(0.16 * NS)) == {doubts.OVERFIT}
    assert evidence.update_doubts(set(), NS + round(0.24 * NS)) == {doubts.OVERFIT}
    assert evidence.update_doubts(set(), NS + round(0.32 * NS)) == set()
    # Smoothed poses are doubtful only at the time at which the doubt was found.
    assert not evidence.was_filter_doubtful(NS + round(0.32 * NS))
    assert evidence.was_filter_doubtful(NS + round(0.16 * NS))


def test_a_doubt_that_began_earlier_flags_earlier_smoothed_poses():
    """A long vehicle that is tracked as two vehicles has wrong poses before the error is found."""
    evidence = TrackEvidence(2)
    evidence.flag_interval(doubts.ANOTHER_VEHICLE, 5 * NS, 3.0, since_ns=3 * NS)
    assert doubts.ANOTHER_VEHICLE in evidence.update_doubts(set(), 7 * NS)
    assert doubts.ANOTHER_VEHICLE not in evidence.update_doubts(set(), 9 * NS)
    assert [evidence.was_filter_doubtful(t * NS) for t in (2, 3, 5, 7, 9)] == [
        False, True, True, True, False]
    # Without an earlier beginning, no smoothed pose is doubtful.
    evidence = TrackEvidence(2)
    evidence.flag_interval(doubts.ANOTHER_VEHICLE, 5 * NS, 3.0)
    assert not any(evidence.was_filter_doubtful(t * NS) for t in range(10))
