"""Ratio of the track error to its Cramér-Rao bound, as reported by replays with ground truth."""

import numpy as np
import pytest

from mag_tracking.analysis.track_errors import error_over_bound
from mag_tracking.analysis.track_log import TrackLog
from support.passes import NOISE, ROAD

N = 30


def log_with_errors(errors, noise=NOISE, missing=False):
    """Create the log of a straight track with position errors (n, 3), and its ground truth.

    If `missing`, the second sensor has no measurements.
    """
    t = 0.08 * np.arange(N)
    true_path = np.column_stack([10.0 * t - 12.0, np.full(N, 1.0), np.full(N, 0.5)])
    log = TrackLog(1)
    log.stamp_ns = np.round(1e9 * t).astype(np.int64).tolist()
    log.position, log.moment = list(true_path + errors), [np.array([100.0, 200.0, -300.0])] * N
    field = np.zeros((N, 2, 3))
    if missing:
        field[:, 1] = np.nan
    log.measured, log.noise = list(field), [np.tile(noise**2 * np.eye(3), (2, 1, 1))] * N
    return log, (np.array(log.stamp_ns), true_path, np.zeros((N, 4)))


def error_ratio(log, truth, rows=range(N), field_error=0.0):
    return error_over_bound(ROAD, log, truth, np.array([1.0, 1.0, 0.01]), 0.1, field_error, 1e-8,
                            np.array(rows), 2)


def test_ratio_is_proportional_to_the_error():
    e = 0.1 * np.random.default_rng(1).standard_normal((N, 3)) * [1.0, 1.0, 0.0]
    reference = error_ratio(*log_with_errors(e))
    assert error_ratio(*log_with_errors(3.0 * e)) == pytest.approx(3.0 * reference)
    assert error_ratio(*log_with_errors(np.zeros((N, 3)))) == 0.0


def test_poorer_sensors_have_a_larger_bound():
    e = np.full((N, 3), 0.1)
    reference = error_ratio(*log_with_errors(e))
    assert error_ratio(*log_with_errors(e, 4.0 * NOISE)) < 0.7 * reference
    assert error_ratio(*log_with_errors(e, missing=True)) < 0.7 * reference
    assert error_ratio(*log_with_errors(e), field_error=0.1) < reference


def test_poses_without_ground_truth_are_ignored():
    log, (stamps, true_path, q) = log_with_errors(np.full((N, 3), 0.1))
    assert error_ratio(log, (stamps[:1], true_path[:1], q[:1])) is None
    assert error_ratio(log, (stamps[:20], true_path[:20], q[:20]), range(25, N)) is None
    log.position[0] = np.array([1e3, 0.0, 0.0])
    assert error_ratio(log, (stamps, true_path, q), range(5, N)) < 20.0


def test_ratio_of_magnet_tracks_is_within_its_limits(magnet_replays):
    """The design target is a ratio of 1; the limit of 3 is the achieved ratio with a margin."""
    for run, _ in magnet_replays.values():
        ratio_to_bound = run.summary['tracks'][0]['truth']['error_over_bound']
        print(f'magnet: error over path bound {ratio_to_bound:.2f}')
        assert 0.1 < ratio_to_bound < 3.0
