"""Features of signatures: invariances, and rejected signatures."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.analysis.signature import features
from support.labelled_passes import signature


def example_signature(seed=0, name='car'):
    return signature(np.random.default_rng(seed), name, 'boxes')


def changed(s, t=None, field=None):
    return replace(s, t=s.t if t is None else t, field=s.field if field is None else field)


def test_duration_does_not_affect_the_features():
    s = example_signature()
    np.testing.assert_allclose(features(changed(s, t=3.7 * s.t + 100.0)), features(s), atol=1e-9)


def test_the_unit_affects_only_the_magnitude_feature():
    s = example_signature()
    first, other = features(s), features(changed(s, field=1e9 * s.field))
    assert other[0] - first[0] == pytest.approx(np.log(1e9))
    np.testing.assert_allclose(other[1:], first[1:], atol=1e-6)


@pytest.mark.parametrize('unit', [1e200, 1e-200])
def test_values_of_any_magnitude_have_features(unit):
    s = example_signature()
    scaled_features = features(changed(s, field=unit * 1e6 * s.field))
    np.testing.assert_allclose(scaled_features[1:], features(s)[1:], atol=1e-6)


def test_baseline_and_drift_have_no_effect():
    s = example_signature()
    drifting = s.field + [3e-5, -1e-5, 4e-5] + 1e-7 * s.t[:, None]
    np.testing.assert_allclose(features(changed(s, field=drifting)), features(s), atol=1e-6)


def test_quiet_ends_have_little_effect():
    s = example_signature()
    t = np.arange(0.0, s.t[-1] + 4.0, 0.02)
    rng = np.random.default_rng(1)
    field = 2e-8 * rng.standard_normal((len(t), 3))
    inside = (t >= 2.0) & (t <= s.t[-1] + 2.0)
    field[inside] += np.stack([np.interp(t[inside] - 2.0, s.t, axis - axis[0])
                               for axis in s.field.T], axis=1)
    difference = np.abs(features(changed(s, t=t, field=field)) - features(s))
    assert np.median(difference) < 0.1


@pytest.mark.parametrize(('t', 'field', 'message'), [
    (np.arange(5.0), np.ones((5, 3)), 'too few'),
    (np.arange(20.0), np.ones((20, 3)), 'is constant'),
    (np.arange(20.0), np.full((20, 3), np.nan), 'not finite'),
    (np.zeros(20), np.random.default_rng(0).standard_normal((20, 3)), 'increase')])
def test_invalid_signatures_are_rejected(t, field, message):
    with pytest.raises(ValueError, match=message):
        features(changed(example_signature(), t, field))
