"""`make bench`: driving directions by single sensors, in a replica of published traffic."""

import sys

from tqdm import tqdm

from bench.figures import Figures
from support.two_way_traffic import calibration, passings, shares

SIMULATORS = ('clouds', 'boxes')
SEEDS = (1, 2, 3)
"""Replicas of 511 vehicles."""
PUBLISHED = {'near': 510 / 511, 'far': 454 / 511, 'fused': 494 / 511}
LIKELIHOOD = {'near': 488 / 511, 'far': 379 / 511, 'fused': 480 / 511}
AIMS = {'near': 0.998, 'far': None, 'fused': 0.97}
MAX_SEPARATION = 0.05
"""Stated error probabilities are right within this."""


def main():
    """Print the figures; 1 where an aim is missed."""
    figures = Figures('directions')
    print('Driving directions, by one sensor with two axes and by two')
    for simulator in SIMULATORS:
        vehicles = [v for seed in tqdm(SEEDS, desc=simulator, disable=None, leave=False)
                    for v in passings(simulator, seed)]
        for method, published, found in (
                ('correlation', PUBLISHED, [v.log_odds_of_north() for v in vehicles]),
                ('likelihood ratio', LIKELIHOOD, [
                    v.likelihood_ratio_of_north() for v in tqdm(
                        vehicles, desc='likelihood ratio', disable=None, leave=False)])):
            share = shares(vehicles, found)
            for name, at_least in AIMS.items():
                figures.add(f'{simulator}, {method}, {name}', getattr(share, name), '',
                            at_least if method == 'correlation' else None, True,
                            f' (published {published[name]:.4f})')
        stated, measured = calibration(vehicles)
        figures.add(f'{simulator}, far lane: stated less measured error probability',
                    abs(stated - measured), '', MAX_SEPARATION, False,
                    f' ({stated:.3f} stated, {measured:.3f} measured)')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
