"""Track log: verdict of its summary, unique or ambiguous."""

import numpy as np
import pytest

from mag_tracking.analysis.track_log import TrackLog


@pytest.mark.parametrize('ambiguous, verdict', [
    ([True, False, False], 'unique'), ([False, True, False], 'ambiguous'),
    ([False, False, True], 'ambiguous')])
def test_a_track_is_unique_if_its_most_certain_and_last_poses_are_unique(ambiguous, verdict):
    log = TrackLog(1)
    for k, variance in enumerate((9.0, 1.0, 4.0)):
        log.stamp_ns.append(k)
        log.velocity.append(np.ones(3))
        log.covariance.append(variance * np.eye(6))
        log.moment.append(np.ones(3))
        log.arrivals.append({'left': (1.0, np.zeros(3), np.eye(2))})
        log.kind.append('car')
        log.kind_weight.append(1.0)
        log.length.append(4.0)
        log.nis.append(1.0)
        log.degrees_of_freedom.append(6)
        log.ambiguous.append(ambiguous[k])
    log.existence = 1.0
    assert log.summary()['verdict'] == verdict
