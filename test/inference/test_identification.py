"""Identification of enrolled vehicles: published passes of a vehicle, and two similar cars."""

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.inference.identification import PASS_TO_PASS_STD, UNKNOWN, enrol, identify
from mag_tracking.physics.dipole import MU0
from support.vehicle_5 import TABLE

SCALE = 450.0
"""[A m^2] Unit of moment of T10, from the moments of the same vehicles in TSP14 and T10."""
MOMENTS = SCALE * TABLE[:, 1:4]
COVARIANCES = np.array([np.diag((SCALE * std)**2) for std in TABLE[:, 4:7]])
HEADINGS = np.deg2rad(TABLE[:, 0])
H = 1.7e-7 * np.array([0.0, 0.31, -0.95]) / MU0 * 3.0 * SCALE
"""(3,) A/m, ambient field strength B0/mu0, world frame."""
HARD, SOFT = SCALE * np.array([-0.47, 0.29, -0.56]), 1.22


def distances(between_std, monkeypatch):
    """Squared Mahalanobis distances of the published passes, each predicted from all others."""
    monkeypatch.setattr('mag_tracking.inference.identification.PASS_TO_PASS_STD', between_std)
    out = []
    for k in range(len(TABLE)):
        rest = np.arange(len(TABLE)) != k
        vehicle = enrol('5', MOMENTS[rest], COVARIANCES[rest], HEADINGS[rest], H)
        found = identify([vehicle], MOMENTS[k], COVARIANCES[k], HEADINGS[k], 0.0, H)
        out.append(found.distances['5'])
    return np.array(out)


def test_published_passes_are_consistent_with_the_spread_between_passes(monkeypatch):
    """T10 Table 6.9, leave-one-out: without the spread, the published covariances are too small."""
    low, high = chi2.ppf([0.005, 0.995], 3 * len(TABLE)) / len(TABLE)
    assert low < distances(PASS_TO_PASS_STD, monkeypatch).mean() < high
    assert distances(1e-6, monkeypatch).mean() > high


def test_a_pass_at_another_heading_than_enrolled_is_identified():
    """T10 Table 6.9; the vehicle is enrolled without the passes at the tested heading."""
    for heading in np.unique(HEADINGS):
        rest = heading != HEADINGS
        vehicle = enrol('5', MOMENTS[rest], COVARIANCES[rest], HEADINGS[rest], H)
        for k in np.flatnonzero(~rest):
            found = identify([vehicle], MOMENTS[k], COVARIANCES[k], heading, 0.02, H)
            assert found.name == '5', (np.rad2deg(heading), found.distances)


def moment_at(hard, heading):
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ hard + SOFT * H


def rotated_hard_iron(degrees):
    """Hard iron of another car: HARD rotated about the vertical, with the same magnitude."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ HARD


@pytest.mark.parametrize('degrees', [60, 90, 120, 180])
def test_two_cars_with_moments_of_equal_magnitude_are_distinguished(degrees):
    """As in T10 Fig. 7.1, cars enrolled at two headings are identified at any heading."""
    rng, C = np.random.default_rng(degrees), np.diag([8.0, 8.0, 15.0])**2
    spread = np.linalg.cholesky(C + PASS_TO_PASS_STD**2 * np.eye(3))
    cars = {'vehicle 5': HARD, 'other': rotated_hard_iron(degrees)}
    enrolled_at = np.deg2rad([90.0, 90.0, 270.0, 270.0])

    def passes(hard, headings):
        return np.array([moment_at(hard, h) + spread @ rng.standard_normal(3) for h in headings])

    fleet = [enrol(name, passes(hard, enrolled_at), np.tile(C, (4, 1, 1)), enrolled_at, H)
             for name, hard in cars.items()]
    # The 90 % ellipses of the horizontal moment do not touch at the headings of the figure.
    for heading in enrolled_at:
        (mean, P), (other_mean, Q) = (v.moment_at(heading, 0.0, H) for v in fleet)
        e = (mean - other_mean)[:2]
        radii = [np.sqrt(chi2.ppf(0.9, 2) * e @ S[:2, :2] @ e) / np.linalg.norm(e) for S in (P, Q)]
        assert sum(radii) < np.linalg.norm(e)
    is_correct = [identify(fleet, m, C, heading, 0.02, H).name == name
                  for name, hard in cars.items()
                  for heading in np.deg2rad([90.0, 270.0, 20.0, 200.0])
                  for m in passes(hard, [heading] * 10)]
    # One pass in a hundred exceeds the threshold of `unknown`.
    assert np.mean(is_correct) > 0.99 - 3.0 * np.sqrt(0.01 * 0.99 / len(is_correct))


def test_a_vehicle_enrolled_at_one_heading_is_compared_only_at_this_heading():
    C = np.tile(np.diag([10.0] * 3)**2, (2, 1, 1))
    headings = np.deg2rad([88.0, 92.0])
    vehicle = enrol('van', np.array([moment_at(HARD, h) for h in headings]), C, headings, H)
    assert vehicle.iron is None
    found = identify([vehicle], moment_at(HARD, np.pi / 2), C[0], np.pi / 2, 0.02, H)
    assert found.name == 'van' and found.probabilities == {'van': 1.0}
    found = identify([vehicle], moment_at(HARD, 0.0), C[0], 0.0, 0.02, H)
    assert found.name == UNKNOWN and not found.probabilities


def test_a_vehicle_not_enrolled_is_unknown():
    C = np.tile(np.diag([10.0] * 3)**2, (4, 1, 1))
    headings = np.deg2rad([0.0, 90.0, 180.0, 270.0])
    vehicle = enrol('van', np.array([moment_at(HARD, h) for h in headings]), C, headings, H)
    found = identify([vehicle], moment_at(2.0 * rotated_hard_iron(90), 0.3), C[0], 0.3, 0.02,
                     H)
    assert found.name == UNKNOWN and found.distances['van'] > 11.3


@pytest.mark.parametrize(('headings', 'message'), [
    ([], 'one pass'), ([0.0, 25.0], '25 degrees')])
def test_insufficient_passes_are_not_enrolled(headings, message):
    headings = np.deg2rad(headings)
    moments = np.array([moment_at(HARD, h) for h in headings]).reshape(-1, 3)
    with pytest.raises(ValueError, match=message):
        enrol('van', moments, np.tile(np.eye(3), (len(headings), 1, 1)), headings, H)
