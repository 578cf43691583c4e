"""`make bench`: errors of ambiguous poses over what the pose topics say, in two simulators.

Seventeen random passes of each kind of each simulator, with each of `track.ambiguous_poses`.
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
    """`Tracked` of a random pass with a policy for the topics."""
    return one_random_pass(simulator, kind, seed, {'track.ambiguous_poses': policy})


def passes_of(policy, seed):
    """[`Tracked`] of one pass of each kind of each simulator."""
    return [one_pass(policy, s, k, seed) for s in SIMULATORS for k in KINDS]


def summary(figures, policy, found):
    """(line, whether the aim is met) of [[`Tracked`]]."""
    found = [f for some in found for f in some]
    ambiguous = np.concatenate([f.ambiguous for f in found])
    nees = np.concatenate([f.topic_nees for f in found])
    error = np.concatenate([f.error for f in found])
    on_topic = ambiguous & np.isfinite(nees)
    if policy == HOLD:
        figures.keep(f'{policy}: ambiguous poses on the topics', on_topic.sum(), '', 0)
        return (f'  {policy}: of {ambiguous.sum()} ambiguous poses {on_topic.sum()} on the topics, '
                f'of {(~ambiguous).sum()} others {np.isfinite(nees[~ambiguous]).sum()}',
                not on_topic.any())
    met = not figures.keep(f'{policy}: ANEES of ambiguous poses', nees[on_topic].mean(), '',
                           MAX_ANEES if policy == MIXTURE else None,
                           note=f'{on_topic.sum()} poses of {len(found)} passes')
    figures.keep(f'{policy}: ANEES of the other poses', nees[~ambiguous].mean(), '')
    return (f'  {policy}: {len(found)} passes, {on_topic.sum()} ambiguous poses, ANEES '
            f'{nees[on_topic].mean():.2f}{f" (aim {MAX_ANEES:g})" if policy == MIXTURE else ""}, '
            f'99 % below {np.quantile(nees[on_topic], 0.99):.1f}, largest error '
            f'{error[on_topic].max():.1f} m; others {nees[~ambiguous].mean():.2f}'
            f'{"" if met else "  MISSED"}', met)


def main():
    """Print a line for each policy; returns 1 where the aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--passes', type=int, default=17, help='of each kind of each simulator')
    n = parser.parse_args().passes
    print('Poses on ~/pose, two sensors, 100 Hz, random passes of two simulators')
    figures = Figures('ambiguous_poses')
    status = count_over([(policy,) for policy in (MIXTURE, HOLD, BEST)], passes_of, n,
                        partial(summary, figures))
    figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
