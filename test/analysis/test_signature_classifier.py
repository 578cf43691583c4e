"""Classifier of signatures: accuracy, calibration, unknown signatures, and rejected labels."""

from functools import cache

import numpy as np
import pytest

from mag_tracking.analysis.signature_classifier import (
    evaluate,
    evaluate_splits,
    expected_calibration_error,
    train,
)
from mag_tracking.apps.classes import examples_of
from mag_tracking.errors import LabelsError
from mag_tracking.inference.identification import UNKNOWN
from mag_tracking.recording.signature_tables import read_model, write_model
from support.labelled_passes import signatures

COUNTS = {'motorcycle': 20, 'car': 100, 'truck': 20}


@cache
def examples(simulator='boxes', seed=0):
    return examples_of(signatures(COUNTS, simulator, seed))


def train_model(e):
    return train(e.x, e.labels, e.groups, e.axes, e.unit)


@pytest.mark.parametrize('simulator', ['clouds', 'boxes'])
def test_accuracy_exceeds_the_fraction_of_the_largest_class(simulator):
    e = examples(simulator)
    evaluation = evaluate_splits(e.x, e.labels, e.groups, e.axes, e.unit, 5)
    assert evaluation.majority == pytest.approx(100 / 140, abs=0.03)
    assert evaluation.accuracy.mean() > evaluation.majority + 0.05
    # A constant prediction has a balanced accuracy of one third.
    assert evaluation.balanced_accuracy.mean() > 0.65
    # The target is 0.05; the limit adds three standard errors of 5 x 42 predictions.
    assert evaluation.expected_calibration_error < 0.05 + 3.0 * np.sqrt(0.1 / 210)
    assert evaluation.unknown.mean() < 0.1


def test_a_signature_far_from_all_examples_is_unknown():
    e = examples()
    model = train_model(e)
    assert np.mean(np.array(model.names(e.x)) == UNKNOWN) < 0.05
    far = e.x + 8.0 * model.scale * np.random.default_rng(0).choice([-1.0, 1.0], e.x.shape)
    assert set(model.names(far)) == {UNKNOWN}
    assert model.posterior(far).sum(axis=1) == pytest.approx(1.0)


def test_training_is_reproducible_and_a_model_file_is_lossless(tmp_path):
    e, other = examples(), examples(seed=1)
    model = train_model(e)
    write_model(tmp_path / 'classes.json', model)
    again, stored = train_model(e), read_model(tmp_path / 'classes.json')
    for model_copy in (again, stored):
        np.testing.assert_array_equal(model_copy.posterior(other.x), model.posterior(other.x))
        assert model_copy.names(other.x) == model.names(other.x)
    assert evaluate(stored, other.x, other.labels).accuracy[0] > 0.8
    with pytest.raises(LabelsError, match='tank'):
        evaluate(stored, other.x, ['tank'] * len(other.labels))


def test_two_classes_have_probabilities():
    e = examples()
    rows = [k for k, label in enumerate(e.labels) if label != 'motorcycle']
    model = train(e.x[rows], [e.labels[k] for k in rows], [e.groups[k] for k in rows], e.axes, 'T')
    p = model.posterior(e.x[rows])
    assert p.shape == (len(rows), 2) and p.sum(axis=1) == pytest.approx(1.0)
    assert np.mean([model.classes[k] == e.labels[r]
                    for k, r in zip(p.argmax(axis=1), rows, strict=True)]) > 0.9


@pytest.mark.parametrize(('labels', 'message'), [
    (['car'] * 10, 'got car'), (['car'] * 9 + ['truck'], "1 of 'truck'"),
    (['car'] * 5 + [''] * 5, 'missing for 5'),
    (['car'] * 5 + ['unknown'] * 5, 'rename')])
def test_labels_unsuitable_for_training_are_rejected(labels, message):
    x = np.random.default_rng(0).standard_normal((10, 4))
    with pytest.raises(LabelsError, match=message):
        train(x, labels, list(map(str, range(10))), ('x',), 'T')


def test_expected_calibration_error_follows_its_definition():
    error = expected_calibration_error(np.array([0.9] * 10), np.array([True] * 9 + [False]))
    assert error == pytest.approx(0.0)
    error = expected_calibration_error(np.array([0.95] * 10), np.array([True] * 5 + [False] * 5))
    assert error == pytest.approx(0.45)


def test_random_labels_are_not_learnt_from_sensors_of_one_pass():
    """The signatures of a pass at four sensors are similar; splitting a pass would leak labels."""
    rng = np.random.default_rng(2)
    pass_features = rng.standard_normal((40, 20)).repeat(4, axis=0)
    x = pass_features + 0.01 * rng.standard_normal(pass_features.shape)
    labels = rng.choice(['a', 'b'], 40).repeat(4).tolist()
    groups = list(map(str, np.arange(40).repeat(4)))
    evaluation = evaluate_splits(x, labels, groups, ('x',), 'T', 10)
    # The limit is three standard errors of ten overlapping splits with twelve test passes each.
    assert abs(evaluation.balanced_accuracy.mean() - 0.5) < 0.25
    assert evaluation.accuracy.mean() < 0.8
