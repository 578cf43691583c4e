"""Consistency of ambiguous poses on the pose topics, for each choice of `track.ambiguous_poses`.

Random passes of trucks, cars and turning cars from two simulators are tracked with two sensors at
100 Hz. The figures are the normalised errors (ANEES per axis) with the published covariances.
The aim is an ANEES of at most 2 for ambiguous poses with `mixture`. With `hold`, no ambiguous pose
may be published.
"""

import argparse
import sys
from functools import partial

import numpy as np

from bench.figures import Figures
from bench.two_simulators import count_over
from mag_tracking.stages.track.settings import BEST, HOLD, MIXTURE
from support.random_passes import KINDS, SIMULATORS, one_random_pass

MAX_ANEES = 2.0


def one_pass(policy, simulator, kind, seed):
    """Track a random pass with a policy for ambiguous poses; return its `Tracked`."""
    return one_random_pass(simulator, kind, seed, {'track.ambiguous_poses': policy})


def passes_of(policy, seed):
    """Track one pass of each kind and simulator; return [`Tracked`]."""
    return [one_pass(policy, s, k, seed) for s in SIMULATORS for k in KINDS]


def summary(figures, policy, found):
    """Record the figures of a policy for ambiguous poses; return (text, whether the aim is met)."""
    found = [f for passes in found for f in passes]
    ambiguous = np.concatenate([f.ambiguous for f in found])
    nees = np.concatenate([f.topic_nees for f in found])
    error = np.concatenate([f.error for f in found])
    on_topic = ambiguous & np.isfinite(nees)
    if policy == HOLD:
        figures.record(f'{policy}: ambiguous poses on the topics', on_topic.sum(), '', 0)
        return (f'  {policy}: {on_topic.sum()} of {ambiguous.sum()} ambiguous poses on the topics, '
                f'{np.isfinite(nees[~ambiguous]).sum()} of {(~ambiguous).sum()} other poses',
                not on_topic.any())
    met = not figures.record(f'{policy}: ANEES of ambiguous poses', nees[on_topic].mean(), '',
                             MAX_ANEES if policy == MIXTURE else None,
                             note=f'{on_topic.sum()} poses of {len(found)} passes')
    figures.record(f'{policy}: ANEES of the other poses', nees[~ambiguous].mean(), '')
    return (f'  {policy}: {len(found)} passes, {on_topic.sum()} ambiguous poses, ANEES '
            f'{nees[on_topic].mean():.2f}{f" (aim {MAX_ANEES:g})" if policy == MIXTURE else ""}, '
            f'99 % below {np.quantile(nees[on_topic], 0.99):.1f}, largest error '
            f'{error[on_topic].max():.1f} m; other poses {nees[~ambiguous].mean():.2f}'
            f'{"" if met else "  MISSED"}', met)


def main():
    """Print a line for each policy; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--passes', type=int, default=17,
                        help='number of passes of each kind and simulator')
    n = parser.parse_args().passes
    print('Poses on ~/pose, two sensors, 100 Hz, random passes of two simulators')
    figures = Figures('ambiguous_poses')
    status = count_over([(policy,) for policy in (MIXTURE, HOLD, BEST)], passes_of, n,
                        partial(summary, figures))
    figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
