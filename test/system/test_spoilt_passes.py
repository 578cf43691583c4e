"""Passes with sensor faults, from each simulator, as evaluated by `make bench`."""

import numpy as np
import pytest

from bench.spoilt_passes import FAULTS, faults_of, faulty_pass
from support.spoilt_runs import recorded

FAULT_NAMES = [name for name, fault in FAULTS.items() if fault]


@pytest.mark.parametrize('name', FAULT_NAMES)
def test_every_fault_changes_the_readings(name):
    readings = recorded('straight_car_right').readings
    for fault in faults_of(name):
        degraded = fault(readings)
        if len(degraded) == len(readings):
            # The recording contains no covariance.
            assert readings.covariance is None
            assert degraded.covariance is not None \
                or (degraded.stamp_ns != readings.stamp_ns).any() \
                or not np.allclose(degraded.field, readings.field, rtol=0.0, atol=1e-12)
        else:
            assert 0 < len(degraded) < len(readings)


@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
def test_a_placeholder_covariance_does_not_change_a_random_pass(simulator):
    original, degraded = (faulty_pass(name, simulator, 'car', 3)
                          for name in ('none', 'stated noise of 0.1 T'))
    assert original.detected and len(original.error) > 10
    np.testing.assert_array_equal(original.error, degraded.error)


@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
def test_a_random_pass_after_dense_traffic_is_ambiguous(simulator):
    found = faulty_pass('dense traffic for 5 s', simulator, 'car', 3)
    assert len(found.error) > 10 and found.ambiguous.all()
