"""Vehicles that stop and go on, and one that stood there when the nodes were started.

`bench.standing` prints the figures.
"""

import pytest

from support.standing import SOON_S, STOPS, TRACKED_M, first_after, goes_on, right_after

RUNS = 20
# Twenty runs of up to a minute and a half, one after the other, on a slow machine.
pytestmark = pytest.mark.timeout(1800)

MIN_RIGHT = 18
"""The aim is all 20: in the others it takes 3.0 and 3.3 s."""


@pytest.mark.parametrize('runs', [2, pytest.param(RUNS, marks=pytest.mark.study)])
def test_the_track_of_a_vehicle_that_stops_goes_on_and_leaves(runs):
    found = [goes_on(STOPS[run % len(STOPS)], run // len(STOPS)) for run in range(runs)]
    assert sum(found) >= 0.9 * runs


@pytest.mark.parametrize('runs, least', [
    (2, 2), pytest.param(RUNS, MIN_RIGHT, marks=pytest.mark.study)])
def test_the_background_is_right_soon_after_a_vehicle_that_stood_there_has_left(runs, least):
    assert sum(right_after(run) <= SOON_S for run in range(runs)) >= least


@pytest.mark.parametrize('runs', [1, pytest.param(RUNS, marks=pytest.mark.study)])
def test_offline_the_first_vehicle_after_it_is_tracked_and_not_wrong(runs):
    for run in range(runs):
        error, n_sure, n_wrong = first_after(run)
        assert error < TRACKED_M and n_sure and n_wrong == 0, run
