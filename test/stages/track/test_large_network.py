"""Poses with and without the limit on the number of hypotheses in `config/large_network.yaml`."""

import numpy as np
import pytest

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Track
from mag_tracking.settings import read_parameter_file
from mag_tracking.simulation.scenario import Path, random_vehicle
from support.bundled import ROOT
from support.marks import studied
from support.networks import line_network
from support.samples import one, simulate

SETTINGS = read_parameter_file(ROOT / 'config' / 'large_network.yaml')
LOST_SEEDS = [8, 13, 15, 18, 63, 118]
"""Seeds of vehicles that are lost if the limit applies from the first frame (the first four), or if
the limit is 60 (the other two)."""


@pytest.fixture(scope='module')
def drive():
    """Function that returns, for a seed and changed settings, [Track] of a random vehicle that
    passes twenty sensors."""
    network, recordings = line_network(20), {}

    def driven(seed, changes):
        if seed not in recordings:
            rng = np.random.default_rng(seed)
            heading, speed = np.pi * rng.integers(2), rng.uniform(6.0, 25.0)
            start = np.array([150.0 if heading else -60.0, rng.uniform(-3.0, 3.0)])
            recordings[seed] = simulate(network, random_vehicle(rng), Path(start, heading, speed),
                                        50.0, 130.0 / speed, rng)[0]
        pipeline = Pipeline(network, settings_for('vehicle', {**SETTINGS, **changes}))
        records = [r for s in recordings[seed] for r in pipeline.feed(one(s))] + pipeline.flush()
        return [r for r in records if isinstance(r, Track) and not r.ended]

    return driven


def distances(some, others):
    """Horizontal distances (n,) between simultaneous poses, in standard deviations of `others`."""
    at = {t.stamp_ns: t for t in others}
    pairs = [(t, at[t.stamp_ns]) for t in some if t.stamp_ns in at]
    assert len(pairs) == len(some) == len(others) > 0
    return np.array([np.sqrt(d @ np.linalg.solve(b.covariance[:2, :2], d)) for d, b in
                     ((a.position[:2] - b.position[:2], b) for a, b in pairs)])


DIFFERING_SEEDS = {76: 'the last of four poses differs by 4 standard deviations; cause unknown'}


@pytest.mark.parametrize('seed', studied(range(150), LOST_SEEDS, lambda seed: [
    pytest.mark.xfail(strict=True, reason=DIFFERING_SEEDS[seed])]
    if seed in DIFFERING_SEEDS else []))
def test_more_hypotheses_do_not_change_the_poses(drive, seed):
    bounded = drive(seed, {})
    free = drive(seed, {'track.max_hypotheses': 100_000})
    d = distances(bounded, free)
    print(f'{seed}: poses differ by {d.max():.2g} std at most, at the end by {d[-1]:.2g} std')
    assert bounded[-1].arrival == free[-1].arrival
    assert d[len(d) // 2:].max() < 0.1
