"""Counts of wrong poses without the ambiguous flag, by comparison with the truth."""

import numpy as np

from mag_tracking.analysis.track_errors import unflagged_poses
from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.apps.replay_report import notes_of
from support.track_records import frame, track_pose

T = np.arange(0.0, 5.0, 0.1)
QUATERNIONS = np.tile([0.0, 0.0, 0.0, 1.0], (len(T), 1))


def truth(y=0.0, shift_s=0.0):
    return (np.round((T + shift_s) * 1e9).astype(np.int64),
            np.stack([10.0 * T, y + 0.0 * T, 0.0 * T], axis=1), QUATERNIONS)


def counts(n, wrong=0, without_truth=0):
    return {'n': n, 'wrong': wrong, 'without_truth': without_truth}


def log(off_m=0.0, std_m=0.1, ambiguous=False):
    """`TrackLog` with poses at the lateral distance `off_m` from the first vehicle."""
    out = TrackLog(1)
    for t in T:
        out.add(track_pose(t, 10.0 * t, off_m, ambiguous=ambiguous,
                           covariance=std_m**2 * np.eye(6)), frame(t))
    return out


def test_a_wrong_pose_has_a_large_error_in_metres_and_in_standard_deviations():
    n = len(T)
    assert unflagged_poses([log(0.5)], [truth()]) == counts(n)
    assert unflagged_poses([log(2.1)], [truth()]) == counts(n, n)
    assert unflagged_poses([log(2.1, std_m=1.0)], [truth()]) == counts(n)
    assert unflagged_poses([log(9.0, ambiguous=True)], [truth()]) == counts(0)


def test_a_pose_near_any_present_vehicle_is_not_wrong():
    assert unflagged_poses([log(5.0)], [truth(), truth(5.0)])['wrong'] == 0
    assert unflagged_poses([log(5.0)], [truth(), truth(-5.0)])['wrong'] == len(T)
    # A vehicle at another time is ignored. Without truth, a pose is not evaluated.
    assert unflagged_poses([log(5.0)], [truth(), truth(5.0, 100.0)])['wrong'] == len(T)
    assert unflagged_poses([log(5.0)], [truth(shift_s=100.0)]) == counts(0, 0, len(T))


def test_the_fraction_of_wrong_poses_is_reported():
    summary = {'diagnoses': [], 'sensors': {}, 'counts': {'track': {}}, 'close_network': False,
               'tracks': [],
               'frames_too_long': None, 'lanes': None, 'clocks_apart': '', 'disturbances': [],
               'target': 'vehicle', 'unflagged_poses': counts(200, 3)}
    assert [n.text.partition(':')[2][:27] for n in notes_of(summary)] == [
        ' 200, of which 3 (1.5%) are']
    assert notes_of({**summary, 'unflagged_poses': None}) == []
