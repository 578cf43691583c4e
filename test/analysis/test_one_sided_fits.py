"""Fits of passes in two lanes beside a road with all sensors on one side."""

import numpy as np
import pytest

from mag_tracking.simulation.scenario import Path
from support.box_vehicles import random_drive
from support.busy_fits import fits_of_world
from support.busy_worlds import FLAWS, RATE, vehicle
from support.passes import network_of
from support.worlds import world

NETWORKS = {'one side': network_of([[-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]]),
            'two sides': network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0]])}
PASS_S, MAX_NEES = 12.0, 2.0


def nees_of(network, simulator, seed):
    """NEES per axis of the horizontal position of each unambiguous fit of a pass."""
    rng = np.random.default_rng([seed, len(simulator), 77])
    direction, speed = int(rng.choice([-1, 1])), rng.uniform(8.0, 20.0)
    near, far = ((2.5, 4.0), (5.5, 7.0)) if network == 'one side' else ((-1.8, 0.0), (0.0, 1.8))
    lane = rng.uniform(*(far if seed % 2 else near))
    path = Path(np.array([-direction * speed * PASS_S, lane]), 0.0 if direction > 0 else np.pi,
                speed)
    body = vehicle(rng, simulator, 0.15)
    course = random_drive(rng, path, PASS_S) if simulator == 'boxes' else path
    of_pass = world(NETWORKS[network], [(body, course)], PASS_S + 7.0, rng, FLAWS[simulator], RATE)
    found = []
    for fit in (fitted.chosen for fitted in fits_of_world(of_pass)):
        if fit is not None and not fit.ambiguous:
            true = [np.interp(fit.data.stamp_ns / 1e9, of_pass.t, of_pass.positions[0][:, k])
                    for k in (0, 1)]
            error = fit.position[:2] - true
            found.append(error @ np.linalg.solve(fit.position_covariance[:2, :2], error) / 2)
    return found


@pytest.mark.study
@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
@pytest.mark.parametrize('network', NETWORKS)
def test_stated_deviations_of_positions_cover_the_errors(network, simulator):
    nees = [v for seed in range(100, 140) for v in nees_of(network, simulator, seed)]
    print(f'{network}, {simulator}: {len(nees)} unambiguous, NEES per axis {np.mean(nees):.2f}')
    assert len(nees) >= 30 and np.mean(nees) <= MAX_NEES


def test_stated_deviations_cover_the_errors_of_some_one_sided_passes():
    nees = [v for simulator in FLAWS for seed in range(3)
            for v in nees_of('one side', simulator, seed)]
    assert len(nees) >= 4 and np.mean(nees) <= MAX_NEES
