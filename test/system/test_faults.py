"""Sensor faults during a pass: the track continues or is flagged, and the fault is named."""

import functools

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
from support.bundled import POINT
from support.faulty_streams import FAULTS, NS, stream
from support.samples import one

MAX_NEES = chi2.ppf(1.0 - 1e-4, 2)
"""NEES above which a pose is wrong."""


@functools.cache
def track_pass(n_sensors, seed, fault=None):
    """Track a pass; return (pipeline, rows, (begin, end) of the fault [s]).

    A row is (t [s], error [m], NEES, flagged).
    """
    network, samples, truth, times = stream(n_sensors, seed, fault)
    pipeline = Pipeline(network, settings_for('vehicle', POINT))
    records = [r for s in samples for r in pipeline.feed(one(s))] + pipeline.flush()
    rows = []
    for t in (r for r in records if isinstance(r, Track) and not r.ended):
        now = t.stamp_ns / NS
        e = t.position[:2] - truth(now)
        rows.append((now, float(np.linalg.norm(e)),
                     float(e @ np.linalg.solve(t.covariance[:2, :2], e)), t.ambiguous))
    return pipeline, rows, times


COUNTED_AS = {
    'dies': ('align', 'frames with a sensor missing'),
    'freezes': ('mag_2', 'rejected: stuck sensor (repeated reading)'),
    'spikes of 2000 times full scale':
        ('mag_2', 'rejected: above 0.001 T (gauss or microtesla published as tesla?)'),
    'spikes within full scale': ('mag_2', 'rejected: spike'),
    'small spikes': ('mag_2', 'rejected: spike'),
    'swaps axes': ('track', 'frames in which mag_2 was rejected'),
    'jumps 1 s ahead': ('align', 'rejected: ahead of all other sensors: mag_2'),
    'jumps 1 s back': ('mag_2', 'rejected: out of order'),
    'sends duplicates': ('mag_2', 'rejected: duplicate timestamp'),
    'sends gauss': ('mag_2', 'rejected: above 0.001 T (gauss or microtesla published as tesla?)'),
}
"""{fault: (stage or sensor that counts it, name of the count)}."""


@pytest.mark.parametrize('fault', list(FAULTS))
@pytest.mark.parametrize('n_sensors, seed', [
    (2, 0), pytest.param(2, 1, marks=pytest.mark.study),
    pytest.param(6, 0, marks=pytest.mark.study)])
def test_a_fault_during_a_pass_is_named_and_gives_no_unflagged_errors(n_sensors, seed, fault):
    _, reference, _ = track_pass(n_sensors, seed)
    pipeline, rows, (begin, end) = track_pass(n_sensors, seed, fault)
    where, what = COUNTED_AS[fault]
    counts = pipeline.calibrate.counts_of(where) if where == 'mag_2' else \
        pipeline.counts()[where]
    # The fault is named, and no reading of other sensors is rejected.
    assert counts[what] > 0
    assert not any(n for s in pipeline.network.names if s != 'mag_2'
                   for key, n in pipeline.calibrate.counts_of(s).items()
                   if key.startswith('rejected'))
    unflagged = sum(z > MAX_NEES and not flagged for _, _, z, flagged in reference)
    wrong = [r for r in rows if r[2] > MAX_NEES and not r[3]]
    assert len(wrong) <= unflagged, wrong[:3]
    if n_sensors > 2:
        # The other sensors support the track, whose accuracy recovers within two seconds.
        during = [r for r in rows if begin < r[0] < end]
        assert len(during) >= 0.9 * (end - begin) / 0.08 - 1
        late = [(r[1], w[1]) for r, w in zip(
            [r for r in rows if end + 2.0 < r[0]],
            [w for w in reference if end + 2.0 < w[0]], strict=False)]
        assert all(with_fault < without_fault + 1.0 for with_fault, without_fault in late)
