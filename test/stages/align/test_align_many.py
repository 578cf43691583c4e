"""Alignment of batches: frames do not depend on how samples are split into batches."""

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.records import Readings
from mag_tracking.settings import replace
from mag_tracking.stages.align import core
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.settings import AlignSettings
from support.disordered_samples import disorder
from support.networks import line_network
from support.samples import batch, one


@settings(max_examples=100)
@given(st.integers(0, 10 ** 6))
def test_batches_give_the_same_frames_as_single_samples(seed):
    n, rng = 1 + seed % 6, np.random.default_rng(seed)
    chosen = replace(AlignSettings(), {
        'burst': bool(rng.integers(2)), 'period_s': float(rng.choice([0.01, 0.03, 0.2])),
        'max_wait_s': float(rng.choice([0.02, 0.1, 60.0])),
        'max_clock_jump_s': float(rng.choice([0.0, 0.05, 0.5])),
        'max_buffered': int(rng.choice([2, 5, 33, 10000]))})
    single, many = Align(line_network(n), chosen), Align(line_network(n), chosen)
    frames, held = ([], []), []
    for s in disorder(rng, n):
        frames[0].extend(single.flush() if s is None else single.feed(one(s)))
        if s is not None:
            held.append(s)
        if s is None or rng.uniform() < 0.1:
            frames[1].extend(many.feed(batch(held)))
            held = []
        if s is None:
            frames[1].extend(many.flush())
    assert single.counts == many.counts and len(frames[0]) == len(frames[1])
    for name in ('stamp_ns', 'field', 'covariance', 'n_samples', 'time_offset'):
        a, b = ([getattr(f, name) for f in some] for some in frames)
        np.testing.assert_array_equal(a, b)


def steady_batches(n, n_readings, start=0, without=()):
    """Batches at 10 ms intervals, each with a sample of every sensor except those in `without`."""
    names = tuple(f'mag_{j + 1}' for j in range(n))
    present = np.array([j for j in range(n) if j not in without])
    return [Readings(names, present, np.full(len(present), 10**18 + k * 10**7),
                     np.ones((len(present), 3)), np.tile(np.eye(3), (len(present), 1, 1)))
            for k in range(start, start + n_readings)]


class CountedAlignment(core.Alignment):
    """`core.Alignment` that counts the returned reason codes over all instances."""

    reasons: Counter[int] = Counter()

    def hold(self, *arguments):
        reason = super().hold(*arguments)
        self.reasons[reason] += 1
        return reason


def reasons_of(stage, readings):
    """Feed readings; return {reason code: how often compiled code returned it}."""
    CountedAlignment.reasons.clear()
    for r in readings:
        stage.feed(r)
    return Counter(CountedAlignment.reasons)


def test_samples_are_aligned_by_compiled_code_again_after_a_clock_step(monkeypatch):
    """The clock of a sensor steps ahead, the sensor falls silent, and later it resumes."""
    monkeypatch.setattr(core, 'Alignment', CountedAlignment)
    stage = Align(line_network(4), replace(AlignSettings(), {'max_buffered': 40,
                                                             'max_wait_s': 2.0}))
    compiled_only = {core.DONE, core.COMPLETE}
    assert set(reasons_of(stage, steady_batches(4, 100))) == compiled_only
    ahead = [Readings(('mag_4',), np.array([0]), np.array([10**18 + 10**10 + k]), np.ones((1, 3)),
                      np.eye(3)[None]) for k in range(3)]
    assert reasons_of(stage, ahead)[core.CLOCK_STEP] == 3
    for r in steady_batches(4, 300, 100, without=(3,)):
        stage.feed(r)
    assert set(reasons_of(stage, steady_batches(4, 100, 400, without=(3,)))) == compiled_only
    for r in steady_batches(4, 200, 500):
        stage.feed(r)
    assert set(reasons_of(stage, steady_batches(4, 100, 700))) == compiled_only
