"""Consistency test of innovations over time: false alarms and detections."""

import numpy as np

from mag_tracking.inference.sequential_tests import (
    FALSE_ALARM_PROBABILITY,
    WINDOW_S,
    InnovationConsistency,
)
from mag_tracking.units import NS

DT = 0.08
AXES = np.array([3, 3])


def run(nis):
    """Return an `InnovationConsistency` to which the NIS (n, n_sensors) of n frames is added."""
    consistency = InnovationConsistency(nis.shape[1])
    for k, row in enumerate(nis):
        consistency.add(row, AXES[:nis.shape[1]], round(k * DT * NS))
    return consistency


def test_consistent_filters_fail_at_the_nominal_rate():
    rng = np.random.default_rng(0)
    n = 2500
    runs = [run(rng.chisquare(3, (30, 2))) for _ in range(n)]
    # The network and, at half the probability each, the two sensors are tested: the total rate is
    # 1e-3 to 2e-3, within four standard deviations of the binomial distribution.
    for failed in (sum(r.fails for r in runs), sum(r.excess > 1.0 for r in runs)):
        assert FALSE_ALARM_PROBABILITY * n - 4 * np.sqrt(n * FALSE_ALARM_PROBABILITY) < failed \
            < 2 * FALSE_ALARM_PROBABILITY * n + 4 * np.sqrt(2 * n * FALSE_ALARM_PROBABILITY)


def test_innovations_twice_as_large_as_expected_are_detected_and_quantified():
    rng = np.random.default_rng(1)
    runs = [run(4.0 * rng.chisquare(3, (30, 2))) for _ in range(200)]
    assert all(r.fails for r in runs)
    assert 3.5 < np.median([r.excess for r in runs]) < 6.0


def test_one_inconsistent_sensor_is_detected():
    rng = np.random.default_rng(2)
    nis = rng.chisquare(3, (30, 2))
    nis[:, 1] *= 0.1
    nis[:, 0] *= 3.0
    assert run(nis).fails


def test_a_burst_expires_with_its_window_and_missing_sensors_are_ignored():
    nis = np.full((40, 2), 1.0)
    nis[10:13] = 40.0
    nis[:, 1] = np.nan
    burst = run(nis[:13])
    assert burst.excess > 1.0
    assert run(nis[:13 + int(WINDOW_S / DT) + 1]).excess == 1.0
    assert run(np.full((5, 2), np.nan)).excess == 1.0
