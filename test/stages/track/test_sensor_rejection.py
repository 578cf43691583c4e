"""Rejection of sensors that contradict the others: rejected sensors, limits and cost."""

import copy
import dataclasses
import functools

import numpy as np
import pytest

from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.physics.dipole import MU0, dipole_field
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.evidence import MAX_SINGLE_SENSOR_S
from mag_tracking.stages.track.initiation_vehicle import vehicle_model
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.sensor_selection import SENSORS_PER_REJECTION, SensorRejection
from support.bundled import POINT
from support.counters import assert_counts, count_of
from support.faulty_streams import NS, stream
from support.networks import line_network
from support.samples import one

SETTINGS = settings_for('vehicle', {**POINT, 'track.mounting_std_deg': 0.0,
                                    'track.model_error_time_s': 0.0}).track
SIGMA = 1.2e-8 / 8**0.5
TARGET_POSITION = np.array([4.0, -1.0, 0.5])
MOMENT = np.array([200.0, -150.0, 80.0])
FAULT_FIELD = np.array([3e-5, -2e-5, 4e-5])
DT = 0.08


class CountingFilter(BankFilter):
    """Filter that counts its updates of banks with several hypotheses."""

    n = 0

    def advance(self, bank, *args, **kwargs):
        self.n += len(bank) > 1
        return super().advance(bank, *args, **kwargs)


def situation(n=6, seed=0, spread=0.3, n_hyp=5):
    """(filter, bank of hypotheses near the truth, frame that fits them, sensor names)."""
    rng = np.random.default_rng(seed)
    network = line_network(n, spacing=4.0, tilt=0.2)
    model = vehicle_model(SETTINGS.vehicle, network)
    bank_filter = CountingFilter(network, model, SETTINGS)
    state = np.array([*TARGET_POSITION, 10.0, 0.0, 0.0, *(MOMENT - 4.0 * network.earth_field / MU0),
                      4.0, 4.0, 4.0])
    x = np.tile(state, (n_hyp, 1))
    x[:, :2] += spread * rng.standard_normal((n_hyp, 2))
    P = np.tile(np.diag([spread, spread, 0.1, 1.0, 0.3, 0.02, 30.0, 30.0, 30.0, 0.2, 0.2,
                         0.2]) ** 2,
                (n_hyp, 1, 1))
    bank = FilterBank.from_targets(x, P, np.arange(n_hyp), n, 1e-8,
                                   bank_filter.observation.own_covariance)
    B = dipole_field(network.positions - TARGET_POSITION, MOMENT)
    field = np.einsum('jik,jk->ji', network.R_sw, B) + SIGMA * rng.standard_normal((n, 3))
    frame = FieldFrame(1000, field, np.tile(SIGMA**2 * np.eye(3), (n, 1, 1)), np.full(n, 8),
                       1e-3 * np.arange(n), True, 99.0, 3 * n)
    return bank_filter, bank, frame, network.names


def with_fault(frame, *rows, size=1.0):
    field = frame.field.copy()
    for k, j in enumerate(rows):
        field[j] += (1.0 + k) * size * FAULT_FIELD
    return dataclasses.replace(frame, field=field)


def without_sensors(frame, *rows):
    """Frame as the alignment would return it without readings of sensors `rows`."""
    rows = list(rows)
    field, covariance = frame.field.copy(), frame.covariance.copy()
    n_samples, offset = frame.n_samples.copy(), frame.time_offset.copy()
    field[rows], covariance[rows], n_samples[rows], offset[rows] = np.nan, np.nan, 0, 0.0
    return dataclasses.replace(frame, field=field, covariance=covariance, n_samples=n_samples,
                               time_offset=offset)


def state(bank):
    return [a.tobytes() for a in (bank.x, bank.P, bank.nis, bank.log_w)]


def same_frame(a, b):
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=True)
               if isinstance(getattr(a, f.name), np.ndarray)
               else getattr(a, f.name) == getattr(b, f.name) for f in dataclasses.fields(a))


def updated_without_rejection(bank_filter, bank, frame):
    """(log-likelihood, state of the bank) after an update without rejection; `bank` is not
    modified."""
    bank = copy.deepcopy(bank)
    return bank_filter.advance(bank, frame, DT)[1], state(bank)


@pytest.mark.parametrize('n', [1, 2, 3, 6, 12])
def test_a_frame_that_fits_is_not_changed_and_costs_one_update(n):
    bank_filter, bank, frame, names = situation(n)
    expected, after = updated_without_rejection(bank_filter, bank, frame)
    bank_filter.n = 0
    _, got, used, counts = SensorRejection(names).advance(bank_filter, bank, frame, DT)
    assert bank_filter.n == 1
    assert used is frame and not counts
    assert got.tobytes() == expected.tobytes() and state(bank) == after


@pytest.mark.parametrize('n', [2, 3, 6])
@pytest.mark.parametrize('seed', range(3))
def test_a_wrong_sensor_is_rejected_as_if_it_were_missing(n, seed):
    bank_filter, bank, frame, names = situation(n, seed)
    for j in range(n) if n > 2 else ():
        updated = copy.deepcopy(bank)
        expected, after = updated_without_rejection(bank_filter, bank, without_sensors(frame, j))
        _, got, used, counts = SensorRejection(names).advance(
            bank_filter, updated, with_fault(frame, j), DT)
        assert_counts(counts, {f' {names[j]} ': 1})
        assert got.tobytes() == expected.tobytes() and state(updated) == after
        assert same_frame(used, without_sensors(frame, j))
    if n == 2:
        # With two sensors the faulty sensor is unknown, but one is rejected and the other is used.
        *_, used, counts = SensorRejection(names).advance(
            bank_filter, bank, with_fault(frame, 1), DT)
        assert sum(counts.values()) == 1 and np.count_nonzero(used.n_samples) == 1


def test_the_frame_and_the_prior_are_not_modified():
    bank_filter, bank, frame, names = situation()
    wrong = with_fault(frame, 2)
    kept = copy.deepcopy(wrong)
    before, prior = (bank.x, bank.P), (bank.x.copy(), bank.P.copy())
    SensorRejection(names).advance(bank_filter, bank, wrong, DT)
    assert same_frame(wrong, kept)
    assert all(np.array_equal(a, b) for a, b in zip(before, prior, strict=True))


@pytest.mark.parametrize('n, max_rejected', [(2, 1), (6, 1), (15, 1), (16, 2), (24, 3)])
def test_one_in_eight_sensors_and_at_least_one_may_be_rejected(n, max_rejected):
    assert max_rejected == max(1, n // SENSORS_PER_REJECTION)
    for wrong in (max_rejected, max_rejected + 1):
        bank_filter, bank, frame, names = situation(n, n_hyp=2)
        # Sensors near the target are faulty, because distant sensors fit any hypothesis.
        near = np.argsort(np.linalg.norm(frame.field, axis=1))[-wrong:].tolist()
        bad = with_fault(frame, *near)
        whole, after = updated_without_rejection(bank_filter, bank, bad)
        _, got, used, counts = SensorRejection(names).advance(bank_filter, bank, bad, DT)
        if wrong == max_rejected and n > 2:
            assert_counts(counts, {f' {names[j]} ': 1 for j in near})
            assert same_frame(used, without_sensors(frame, *near))
        elif wrong > max_rejected:
            # The whole frame is used, bit for bit: the track itself is lost.
            assert not counts and used is bad
            assert got.tobytes() == whole.tobytes() and state(bank) == after


def test_no_sensor_is_rejected_if_all_of_them_contradict_the_track():
    bank_filter, bank, frame, names = situation()
    lost = dataclasses.replace(frame, field=-3.0 * frame.field[::-1])
    expected, after = updated_without_rejection(bank_filter, bank, lost)
    _, got, used, counts = SensorRejection(names).advance(bank_filter, bank, lost, DT)
    assert used is lost and not counts
    assert got.tobytes() == expected.tobytes() and state(bank) == after
    best = int(np.argmax(bank.log_w + got))
    assert bank_filter.is_implausible(bank, best, lost)


def test_a_single_present_sensor_is_never_rejected():
    for n in (1, 6):
        bank_filter, bank, frame, names = situation(n)
        alone = with_fault(without_sensors(frame, *range(1, n)), 0)
        bank_filter.n = 0
        *_, used, counts = SensorRejection(names).advance(bank_filter, bank, alone, DT)
        assert used is alone and not counts and bank_filter.n == 1


def test_the_limit_on_rejected_sensors_counts_present_sensors_only():
    bank_filter, bank, frame, names = situation(16, n_hyp=2)
    near = np.argsort(np.linalg.norm(frame.field, axis=1)).tolist()
    bad = with_fault(without_sensors(frame, near[0]), *near[-2:])
    *_, used, counts = SensorRejection(names).advance(bank_filter, bank, bad, DT)
    assert used is bad and not counts


def test_a_sensor_with_a_missing_axis_is_rejected():
    bank_filter, bank, frame, names = situation()
    field = frame.field.copy()
    field[:, 2] = np.nan
    bad = with_fault(dataclasses.replace(frame, field=field), 3)
    *_, used, counts = SensorRejection(names).advance(bank_filter, bank, bad, DT)
    assert_counts(counts, {f' {names[3]} ': 1})
    assert np.isnan(used.field[3]).all() and not np.isnan(used.field[2, :2]).any()


def cost(bank_filter, rejection, bank, frame):
    """(number of updates, indices of unused sensors); the bank is not modified."""
    bank_filter.n = 0
    *_, used, _ = rejection.advance(bank_filter, copy.deepcopy(bank), frame, DT)
    return bank_filter.n, np.flatnonzero(used.n_samples == 0).tolist()


def test_the_sensor_rejected_in_the_previous_frame_is_tried_first():
    bank_filter, bank, frame, names = situation()
    rejection = SensorRejection(names)
    assert cost(bank_filter, rejection, bank, with_fault(frame, 2)) == (1 + 6 + 1, [2])
    assert cost(bank_filter, rejection, bank, with_fault(frame, 2)) == (2, [2])
    # Now another sensor is faulty.
    assert cost(bank_filter, rejection, bank, with_fault(frame, 4)) == (1 + 1 + 6 + 1, [4])
    # A frame that fits, or the end of a track, clears the suspect.
    assert cost(bank_filter, rejection, bank, frame) == (1, [])
    assert cost(bank_filter, rejection, bank, with_fault(frame, 4)) == (8, [4])
    rejection.clear()
    assert cost(bank_filter, rejection, bank, with_fault(frame, 4)) == (8, [4])
    # A frame in which no rejection helps also clears the suspect.
    assert cost(bank_filter, rejection, bank, with_fault(frame, 2, 4)) == (9, [])
    assert cost(bank_filter, rejection, bank, with_fault(frame, 4)) == (8, [4])
    # A missing sensor is not a suspect, and costs no update.
    assert cost(bank_filter, rejection, bank, with_fault(without_sensors(frame, 4), 2)) == (
        1 + 5 + 1, [2, 4])


def test_previous_suspects_are_kept_if_too_few_sensors_are_present():
    bank_filter, bank, frame, names = situation(16, n_hyp=2)
    near = np.argsort(np.linalg.norm(frame.field, axis=1)).tolist()
    rejection = SensorRejection(names)
    assert cost(bank_filter, rejection, bank, with_fault(frame, *near[-2:]))[1] == sorted(near[-2:])
    fewer = with_fault(without_sensors(frame, near[0]), *near[-2:])
    assert cost(bank_filter, rejection, bank, fewer)[1] == [near[0]]


def test_the_second_of_two_wrong_sensors_is_sought_among_the_others():
    bank_filter, bank, frame, names = situation(16, n_hyp=2)
    near = np.argsort(np.linalg.norm(frame.field, axis=1)).tolist()[-2:]
    assert cost(bank_filter, SensorRejection(names), bank, with_fault(frame, *near)) == (
        1 + 16 + 1 + 15 + 1, sorted(near))


def test_the_frame_must_fit_the_heaviest_hypothesis():
    """Another hypothesis explains the frame. A sensor is rejected only if the weight of that
    hypothesis is negligible."""
    bank_filter, bank, frame, names = situation(n_hyp=2)
    bank.x[1, bank_filter.observation.n_target + 3 * 2:][:3] = FAULT_FIELD
    bad = with_fault(frame, 2)
    assert cost(bank_filter, SensorRejection(names), bank, bad) == (1, [])
    bank.log_w = np.array([0.0, -1e9])
    assert cost(bank_filter, SensorRejection(names), bank, bad) == (8, [2])


class RulingOutFilter(BankFilter):
    """Filter that rules out all hypotheses if the sensor with index `row` is present."""

    def __init__(self, row, *args):
        super().__init__(*args)
        self._row = row

    def advance(self, bank, frame, *args, **kwargs):
        predicted, out = super().advance(bank, frame, *args, **kwargs)
        valid = ~np.isnan(frame.field[self._row]).all()
        return predicted, np.full(len(out), -np.inf) if valid else out


def test_a_sensor_that_rules_out_every_hypothesis_is_rejected():
    plain_filter, bank, frame, names = situation()
    network = line_network(6, spacing=4.0, tilt=0.2)
    ruling_out = RulingOutFilter(3, network, vehicle_model(SETTINGS.vehicle, network), SETTINGS)
    _, after = updated_without_rejection(plain_filter, bank, without_sensors(frame, 3))
    _, got, _, counts = SensorRejection(names).advance(ruling_out, bank, frame, DT)
    assert_counts(counts, {f' {names[3]} ': 1})
    assert np.isfinite(got).all() and state(bank) == after


# Rejection in the tracker.

@functools.cache
def tracked_pass(n_sensors, fault, seed=0, network_at=None, lasting_s=1.0):
    """(pipeline, live tracks, (begin, end) of the fault [s]) of a pass with a fault of mag_2.

    The network is replaced `network_at` [s] after the fault begins.
    """
    network, samples, _, times = stream(n_sensors, seed, fault, lasting_s)
    pipeline, tracks = Pipeline(network, settings_for('vehicle', POINT)), []
    for s in samples:
        if network_at is not None and s.stamp_ns >= (times[0] + network_at) * NS:
            pipeline.track.use_network(dataclasses.replace(network, positions=-network.positions))
            network_at = None
        tracks += [r for r in pipeline.feed(one(s)) if isinstance(r, Track) and not r.ended]
    return pipeline, tracks, times


def test_a_fault_of_one_of_two_sensors_makes_the_track_ambiguous():
    flags = {}
    for fault in (None, 'swaps axes'):
        # The fault is too short for the doubt that only one sensor supports the track.
        pipeline, tracks, (begin, _) = tracked_pass(
            2, fault, seed=1, lasting_s=MAX_SINGLE_SENSOR_S - 0.2)
        flags[fault] = [t.ambiguous for t in tracks if t.stamp_ns / NS > begin + 0.5]
        rejections = [event for event in pipeline.track.counts if 'was rejected' in event]
        assert bool(rejections) == bool(fault)
    assert len(flags['swaps axes']) > 10 and all(flags['swaps axes'])
    assert not any(flags[None])


WRONG_REJECTION = pytest.param(3, 0, marks=pytest.mark.xfail(strict=True, reason=(
    'mag_3 is rejected in 7 of 16 frames, because a track can fit any two of three sensors; '
        'its poses are ambiguous')))


@pytest.mark.parametrize('n_sensors, seed', [WRONG_REJECTION, (3, 1), (3, 2), (3, 3), (6, 0)])
def test_a_fault_of_one_of_several_sensors_leaves_the_track_unambiguous(n_sensors, seed):
    pipeline, tracks, (begin, end) = tracked_pass(n_sensors, 'swaps axes', seed)
    assert count_of(pipeline.track.counts, 'mag_2') > 3
    assert sum('was rejected' in event for event in pipeline.track.counts) == 1
    assert not any(t.ambiguous for t in tracks if t.stamp_ns / NS > end + 0.3)
    # The poses report which sensors were used.
    used = [np.count_nonzero(~np.isnan(t.nis_by_sensor)) for t in tracks
            if begin < t.stamp_ns / NS < end]
    assert {n_sensors - 1} <= set(used) <= {n_sensors - 1, n_sensors}
    assert all(t.degrees_of_freedom == 3 * np.count_nonzero(~np.isnan(t.nis_by_sensor))
               for t in tracks)


def test_a_track_that_is_fitted_to_the_wrong_two_sensors_is_ambiguous():
    pipeline, tracks, (_, end) = tracked_pass(3, 'swaps axes', 0)
    assert [event for event in pipeline.track.counts if 'was rejected' in event]
    after = [t.ambiguous for t in tracks if t.stamp_ns / NS > end + 0.3]
    assert len(after) > 10 and all(after)


def test_no_sensor_is_rejected_without_a_fault():
    pipeline, tracks, _ = tracked_pass(3, None)
    assert len(tracks) > 20
    assert not [event for event in pipeline.track.counts if 'was rejected' in event]


def test_a_new_network_during_a_rejection_does_not_affect_the_track():
    pipeline, tracks, _ = tracked_pass(3, 'swaps axes', network_at=0.5)
    _, expected, _ = tracked_pass(3, 'swaps axes')
    assert [(t.stamp_ns, t.position.tobytes(), t.ambiguous) for t in tracks] == [
        (t.stamp_ns, t.position.tobytes(), t.ambiguous) for t in expected]


@pytest.mark.parametrize('dropout_s, flagged', [(MAX_SINGLE_SENSOR_S - 0.1, False),
                                                (MAX_SINGLE_SENSOR_S + 0.2, True)])
def test_a_track_supported_by_one_sensor_for_too_long_stays_ambiguous(dropout_s, flagged):
    network, samples, _, (begin, end) = stream(2, 0)
    pipeline, tracks = Pipeline(network, settings_for('vehicle', POINT)), []
    for s in samples:
        if s.sensor == 'mag_2' and begin <= s.stamp_ns / NS < begin + dropout_s:
            continue
        tracks += [r for r in pipeline.feed(one(s)) if isinstance(r, Track) and not r.ended]
    live = [t for t in tracks if t.stamp_ns / NS > begin + dropout_s + 0.1]
    alone = [t for t in tracks if np.isnan(t.nis_by_sensor).any()]
    assert len(alone) >= 4 and all(t.ambiguous for t in alone)
    assert live and all(t.ambiguous for t in live) == flagged


def first_tracks(n_quiet, stage=None, begin_ns=NS, missing=(), n_present=1):
    """(stage, tracks) of a target that is present after `n_quiet` frames without a target."""
    network = line_network(2, tilt=0.0)
    stage = TrackManager(network, SETTINGS) if stage is None else stage
    B = dipole_field(network.positions - [-8.0, -1.2, 0.5], MOMENT)
    C, field = np.tile(SIGMA**2 * np.eye(3), (2, 1, 1)), np.einsum('jik,jk->ji', network.R_sw, B)
    for k in range(n_quiet):
        assert not stage.feed(FieldFrame(begin_ns + k * NS // 10, 0.0 * field, C, np.full(2, 8),
                                         np.zeros(2), False))
    valid = ~np.isin(np.arange(2), missing)
    field, C = np.where(valid[:, None], field, np.nan), np.where(valid[:, None, None], C, np.nan)
    tracks = []
    for k in range(n_quiet, n_quiet + n_present):
        tracks += stage.feed(FieldFrame(begin_ns + k * NS // 10, field, C, np.where(valid, 8, 0),
                                        np.zeros(2), True))
    return stage, tracks


def test_a_new_track_does_not_inherit_the_doubts_of_the_previous_one():
    stage, before = first_tracks(8, missing=(1,), n_present=8)
    assert before and all(t.ambiguous for t in before)
    stage.flush()
    _, again = first_tracks(8, stage, 4 * NS, n_present=4)
    _, fresh = first_tracks(8, begin_ns=4 * NS, n_present=4)
    assert again and [(t.ambiguous, t.existence, t.weight) for t in again] == [
        (t.ambiguous, t.existence, t.weight) for t in fresh]


@pytest.mark.parametrize('n_quiet', [0, 4])
def test_a_target_that_was_not_seen_approaching_is_ambiguous(n_quiet):
    """This happens if the tracker is restarted in the middle of a pass."""
    _, tracks = first_tracks(n_quiet)
    assert tracks and all(t.ambiguous for t in tracks)
