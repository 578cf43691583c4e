"""Combinations of simulators and faults that `make bench` evaluates."""

import numpy as np
import pytest

from bench.spoilt_passes import FAULTS, spoil_with, spoilt_pass
from support.spoilt_runs import recorded

FAULT_NAMES = [name for name, fault in FAULTS.items() if fault]


@pytest.mark.parametrize('name', FAULT_NAMES)
def test_every_fault_changes_the_readings(name):
    readings = recorded('straight_car_right').readings
    for fault in spoil_with(name):
        spoilt = fault(readings)
        if len(spoilt) == len(readings):
            # The recording states no covariance.
            assert readings.covariance is None
            assert spoilt.covariance is not None \
                or (spoilt.stamp_ns != readings.stamp_ns).any() \
                or not np.allclose(spoilt.field, readings.field, rtol=0.0, atol=1e-12)
        else:
            assert 0 < len(spoilt) < len(readings)


@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
def test_a_placeholder_covariance_does_not_change_a_random_pass(simulator):
    plain, spoilt = (spoilt_pass(name, simulator, 'car', 3)
                     for name in ('none', 'stated noise of 0.1 T'))
    assert plain.detected and len(plain.error) > 10
    np.testing.assert_array_equal(plain.error, spoilt.error)


@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
def test_a_random_pass_after_dense_traffic_is_ambiguous(simulator):
    found = spoilt_pass('dense traffic for 5 s', simulator, 'car', 3)
    assert len(found.error) > 10 and found.ambiguous.all()
