"""Frames do not depend on how samples are split into batches."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mag_tracking.settings import replace
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.stages.align.stage import Align
from support.disordered_samples import disorder
from support.networks import line_network
from support.samples import batch, one


@settings(max_examples=100)
@given(st.integers(0, 10 ** 6))
def test_batches_give_the_frames_of_single_samples(seed):
    n, rng = 1 + seed % 6, np.random.default_rng(seed)
    wanted = replace(AlignSettings(), {
        'burst': bool(rng.integers(2)), 'period_s': float(rng.choice([0.01, 0.03, 0.2])),
        'max_wait_s': float(rng.choice([0.02, 0.1, 60.0])),
        'ahead_s': float(rng.choice([0.0, 0.05, 0.5])),
        'most_pending': int(rng.choice([2, 5, 33, 10000]))})
    single, many = Align(line_network(n), wanted), Align(line_network(n), wanted)
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
