"""Search for sensors whose field is weaker than the Earth's field."""

import numpy as np
import pytest

from mag_tracking.drivers.sensor_checks import WEAK_S, FieldStrength
from mag_tracking.records import Readings

EARTH = np.array([15e-6, 2e-6, -48e-6])
RNG = np.random.default_rng(5)
T = np.arange(0.0, 10.0, 0.02)
TURN = np.column_stack([np.cos(T), np.sin(T), 0 * T])
ONE_AXIS = np.column_stack([1e-6 + 0 * T, T * np.nan, T * np.nan])


def weak_at(field, batch=25):
    """Return the times [s] at which a sensor A with a field (n, 3) [T] is judged as weak; B has the
    Earth's field."""
    strength, times = FieldStrength(), []
    for k in range(0, len(T), batch):
        own = field[k:k + batch]
        n = len(own)
        stamps = np.repeat(np.round(T[k:k + batch] * 1e9).astype(np.int64), 2)
        readings = Readings(('A', 'B'), np.tile([0, 1], n), stamps, np.stack(
            [own, np.tile(EARTH, (n, 1))], axis=1).reshape(-1, 3))
        weak = strength.add(readings)
        assert set(weak) <= {'A'}
        times += [T[k:k + batch][-1]] * len(weak)
    return times


@pytest.mark.parametrize('scale', [1e-2, 1e-4, 0.0])
def test_a_field_in_a_wrong_unit_is_found_once(scale):
    (time,) = weak_at(scale * (EARTH + RNG.normal(0.0, 1e-7, (len(T), 3))))
    assert WEAK_S <= time <= WEAK_S + 0.5


@pytest.mark.parametrize('field', [
    np.tile(EARTH, (len(T), 1)), 25e-6 * TURN, ONE_AXIS,
    # One of three axes is missing now and then, and the field is strong in between.
    np.where((np.arange(len(T)) % 3 == 0)[:, None], np.nan, EARTH),
    # A sensor whose count is 98 uT.
    98e-6 * np.round((EARTH + RNG.normal(0.0, 1e-4, (len(T), 3))) / 98e-6)],
    ids=['earth', 'rotating', 'one axis', 'gaps', 'coarse'])
def test_other_sensors_are_not_judged_as_weak(field):
    assert weak_at(field) == []
