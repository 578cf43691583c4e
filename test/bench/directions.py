"""Driving directions from single sensors, in a replica of the traffic of PHD15 Paper B.

Three replicas of 511 vehicles on a road with two lanes are simulated by each of two simulators,
with a two-axis sensor on each side of the road. The figures are the fractions of correct directions
from the sensor of the near lane, from the sensor of the far lane and from their fusion, for the
correlation and for the likelihood ratio. The aims for the correlation are 99.8 % for the near
sensor and 97 % for the fusion. The reported error probabilities may differ by at most 0.05 from the
measured error rates.
"""

import sys

from tqdm import tqdm

from bench.figures import Figures
from support.two_way_traffic import far_sensor_error, passings, shares

SIMULATORS = ('clouds', 'boxes')
SEEDS = (1, 2, 3)
"""Seeds of the replicas of 511 vehicles."""
PUBLISHED = {'near': 510 / 511, 'far': 454 / 511, 'fused': 494 / 511}
LIKELIHOOD = {'near': 488 / 511, 'far': 379 / 511, 'fused': 480 / 511}
AIMS = {'near': 0.998, 'far': None, 'fused': 0.97}
MAX_DIFFERENCE = 0.05
"""Maximum difference between reported error probability and measured error rate."""


def main():
    """Print the figures; return 1 if an aim is missed."""
    figures = Figures('directions')
    print('Driving directions by one sensor with two axes, and by two such sensors')
    for simulator in SIMULATORS:
        vehicles = [v for seed in tqdm(SEEDS, desc=simulator, disable=None, leave=False)
                    for v in passings(simulator, seed)]
        for method, published, found in (
                ('correlation', PUBLISHED, [v.log_odds_of_north() for v in vehicles]),
                ('likelihood ratio', LIKELIHOOD, [
                    v.likelihood_ratio_of_north() for v in tqdm(
                        vehicles, desc='likelihood ratio', disable=None, leave=False)])):
            fractions = shares(vehicles, found)
            for name, aim in AIMS.items():
                figures.add(f'{simulator}, {method}, {name}', getattr(fractions, name), '',
                            aim if method == 'correlation' else None, True,
                            f' (published {published[name]:.4f})')
        reported, measured = far_sensor_error(vehicles)
        figures.add(f'{simulator}, far lane: predicted minus measured error probability',
                    abs(reported - measured), '', MAX_DIFFERENCE, False,
                    f' ({reported:.3f} reported, {measured:.3f} measured)')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
