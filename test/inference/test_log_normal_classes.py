"""Vehicle classes by moment and length: posterior, unknown vehicles, and calibration."""

from dataclasses import astuple

import numpy as np
import pytest
from scipy.stats import norm

from mag_tracking.inference.identification import UNKNOWN, Feature, class_posterior
from mag_tracking.stages.traffic.settings import TrafficSettings

NAMES, SHARES, MOMENTS, MOMENT_SPREADS, LENGTHS, LENGTH_SPREADS = zip(
    *map(astuple, TrafficSettings().classes), strict=True)


def posterior(size, length, moment_std=0.0, length_std=0.0):
    features = [Feature(size, moment_std, MOMENTS, MOMENT_SPREADS)]
    if length:
        features.append(Feature(length, length_std, LENGTHS, LENGTH_SPREADS))
    return class_posterior(NAMES, SHARES, features)


@pytest.mark.parametrize(('name', 'size', 'length'), [
    ('motorcycle', 50.0, 0.0), ('car', 335.0, 2.1), ('car', 581.0, 5.0), ('car', 400.0, 0.0),
    ('truck', 1734.0, 9.1), ('truck', 1897.0, 11.3), ('truck', 2500.0, 0.0)])
def test_published_vehicles_are_classified(name, size, length):
    """TSP14 Tables II and V: the smallest and the largest vehicle of each class."""
    found = posterior(size, length, 20.0, 0.3)
    assert found.name == name and found.probabilities.sum() == pytest.approx(1.0)
    assert found.probabilities.max() > 0.8


def test_posterior_follows_bayes_rule():
    size, length, std = 900.0, 6.0, 0.8
    expected = np.array([
        share * norm.pdf(np.log(size), np.log(m), a) * norm.pdf(
            np.log(length), np.log(row), np.hypot(b, std / length))
        for share, m, a, row, b in zip(
            SHARES, MOMENTS, MOMENT_SPREADS, LENGTHS, LENGTH_SPREADS, strict=True)])
    np.testing.assert_allclose(posterior(size, length, 0.0, std).probabilities,
                               expected / expected.sum(), rtol=1e-9)


def test_a_vehicle_that_fits_no_class_is_unknown():
    assert posterior(1e5, 0.0).name == UNKNOWN and posterior(0.5, 0.0).name == UNKNOWN
    assert posterior(400.0, 60.0).name == UNKNOWN
    # With this std of the length, any class is possible.
    assert posterior(400.0, 60.0, length_std=120.0).name == 'car'


def test_posteriors_are_calibrated():
    """Probabilities agree with success rates for vehicles from the assumed distributions."""
    rng = np.random.default_rng(0)
    stated, is_correct = [], []
    for _ in range(4000):
        k = rng.choice(3, p=np.array(SHARES) / sum(SHARES))
        size = MOMENTS[k] * np.exp(MOMENT_SPREADS[k] * rng.standard_normal())
        length = LENGTHS[k] * np.exp(LENGTH_SPREADS[k] * rng.standard_normal())
        found = posterior(size, length if rng.random() < 0.5 else 0.0)
        stated.append(found.probabilities.max())
        is_correct.append(int(np.argmax(found.probabilities)) == k)
    stated, is_correct = np.array(stated), np.array(is_correct)
    for low, high in ((0.33, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.01)):
        in_range = (low <= stated) & (stated < high)
        tolerance = 3.0 * np.sqrt(0.25 / max(in_range.sum(), 1))
        assert abs(stated[in_range].mean() - is_correct[in_range].mean()) < tolerance
