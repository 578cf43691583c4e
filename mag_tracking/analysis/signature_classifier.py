"""Classifier of passes by their signatures at one sensor: training, posteriors, evaluation."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.special import softmax

from mag_tracking.analysis.signature import Signature, features
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import LabelsError, MissingDependencyError
from mag_tracking.inference.identification import UNKNOWN
from mag_tracking.quantities import quantity

VERSION = 1
"""Version of the model file format."""
MIN_SAMPLES = 4
"""Minimum number of training examples of a class."""
N_FOLDS, TEST_FRACTION = 5, 0.3
"""Number of folds of the cross-validation, and fraction of a class in the test part of a split."""
PENALTIES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Candidate values of C, the inverse regularisation strength of the logistic regression."""
KNOWN_QUANTILE = 0.99
"""Quantile of the distances of held-out examples to their class, beyond which it is `unknown`."""
TEMPERATURES = np.geomspace(0.3, 10.0, 40)
"""Candidate temperatures of the logits."""


@dataclass(frozen=True)
class SignatureModel:
    """Linear classifier that rejects signatures far from all classes as unknown."""

    classes: tuple[str, ...]
    axes: tuple[str, ...]
    """Names of the axes of the signatures."""
    unit: str
    """Unit of the fields: T, or empty if unknown."""
    method: str
    """Name of the selected training method."""
    mean: FloatArray
    scale: FloatArray
    """(n_features,) means and standard deviations of the features of the training set."""
    weights: FloatArray
    offsets: FloatArray
    """Weights (n_classes, n_features) of scaled features, offsets (n_classes,) of the logits."""
    temperature: float
    """Divisor of the logits. It corrects overconfidence due to a small training set."""
    centres: FloatArray
    """(n_classes, n_features) mean scaled features of each class."""
    precision: FloatArray
    """(n_features, n_features) inverse of the shrinkage estimate of the within-class covariance."""
    limit: float
    """Maximum squared distance of a signature of a known class to the nearest class centre."""
    examples: dict[str, int]
    """{class: number of training examples}."""

    def posterior(self, x: FloatArray) -> FloatArray:
        """Posterior probabilities (n, n_classes) for features `x` (n, n_features)."""
        z = (x - self.mean) / self.scale
        logits = (z @ self.weights.T + self.offsets) / self.temperature
        return np.asarray(softmax(logits, axis=1))

    def names(self, x: FloatArray) -> list[str]:
        """Most probable class of each signature, or `unknown` beyond `limit` of all classes."""
        best = self.posterior(x).argmax(axis=1)
        distances = _squared_distances((x - self.mean) / self.scale, self.centres, self.precision)
        return [self.classes[k] if distance <= self.limit else UNKNOWN for k, distance in zip(
            best.tolist(), distances.min(axis=1).tolist(), strict=True)]


@dataclass(frozen=True)
class Evaluation:
    """Accuracy of classifiers on one or several test sets."""

    classes: tuple[str, ...]
    n: int
    """Number of signatures in the first test set."""
    majority: float
    """Fraction of the largest class, which is the accuracy of a constant prediction."""
    accuracy: FloatArray
    """(n_sets,) fraction of correct predictions; `unknown` counts as incorrect."""
    balanced_accuracy: FloatArray
    """(n_sets,) mean recall of the classes."""
    recall: FloatArray
    """(n_sets, n_classes) recall of each class; NaN for a class without test signatures."""
    unknown: FloatArray
    """(n_sets,) fraction of `unknown` predictions."""
    expected_calibration_error: float
    """Mean absolute difference of probability and accuracy over bins of the probability."""


def feature_table(signatures: Sequence[Signature]) -> tuple[FloatArray, IntArray, list[str]]:
    """Features, indices of the signatures that have features, and reasons for the others; raises
    LabelsError if the signatures have different axes or units."""
    axes = Counter((' '.join(s.axes), s.unit) for s in signatures)
    if len(axes) > 1:
        raise LabelsError('the signatures have different axes or units: ' + ', '.join(
            f'{n} with {name or "none"} [{unit or "unit unknown"}]'
            for (name, unit), n in sorted(axes.items())))
    rows, table, reasons = [], [], []
    for i, signature in enumerate(signatures):
        try:
            table.append(features(signature))
            rows.append(i)
        except ValueError as error:
            reasons.append(f'{signature.source}: {error}')
    return np.array(table, ndmin=2), np.array(rows, dtype=np.int64), reasons


def train(x: FloatArray, labels: Sequence[str], groups: Sequence[str], axes: tuple[str, ...],
          unit: str, seed: int = 0) -> SignatureModel:
    """Train a classifier; select its method and penalty by cross-validation.

    A fold never splits a group. Raises LabelsError for fewer than two classes or too few examples
    of one, MissingDependencyError without scikit-learn.
    """
    counts = check_labels(labels, groups)
    classes = tuple(sorted(counts))
    y = np.array([classes.index(label) for label in labels])
    mean, scale = x.mean(axis=0), x.std(axis=0)
    scale = np.where(scale > 1e-9 * (1.0 + np.abs(mean)), scale, 1.0)
    z = (x - mean) / scale
    folds = list(_folds(y, groups, min(N_FOLDS, min(counts.values())), seed))
    candidates = []
    for name, create_estimator in _candidates():
        held_out_logits = np.zeros((len(y), len(classes)))
        for train_rows, test_rows in folds:
            weights, offsets = _weights_and_offsets(
                create_estimator().fit(z[train_rows], y[train_rows]), len(classes))
            held_out_logits[test_rows] = z[test_rows] @ weights.T + offsets
        probabilities = (softmax(held_out_logits / t, axis=1)[np.arange(len(y)), y]
                         for t in TEMPERATURES)
        losses = [float(-np.mean(np.log(np.maximum(p, 1e-300)))) for p in probabilities]
        k = int(np.argmin(losses))
        candidates.append((losses[k], name, create_estimator, float(TEMPERATURES[k])))
    _, name, create_estimator, temperature = min(candidates, key=lambda s: s[0])
    fitted = create_estimator().fit(z, y)
    held_out = []
    for train_rows, test_rows in folds:
        distances = _squared_distances(
            z[test_rows], *_class_statistics(z[train_rows], y[train_rows]))
        held_out.append(distances[np.arange(len(test_rows)), y[test_rows]])
    return SignatureModel(
        classes, axes, unit, name, mean, scale, *_weights_and_offsets(fitted, len(classes)),
        temperature, *_class_statistics(z, y),
        float(np.quantile(np.concatenate(held_out), KNOWN_QUANTILE)), dict(counts))


def check_labels(labels: Sequence[str], groups: Sequence[str]) -> 'Counter[str]':
    """Count the targets of each class; raises LabelsError if a classifier cannot be trained because
    a label is empty or reserved, or there are too few classes or examples."""
    counts = Counter(label for label, _ in set(zip(labels, groups, strict=True)))
    if '' in counts:
        raise LabelsError(f'labels are missing for {quantity(counts[""], "target")}; label or '
                          'remove the signatures')
    if UNKNOWN in counts:
        raise LabelsError(f'the label {UNKNOWN!r} is reserved for unclassified signatures; rename '
                          'the class')
    if len(counts) < 2:
        raise LabelsError(f'expected at least two classes, got {", ".join(counts) or "none"}')
    scarce = {name: n for name, n in counts.items() if n < MIN_SAMPLES}
    if scarce:
        raise LabelsError('expected at least ' + str(MIN_SAMPLES) + ' examples of each class, got '
                          + ', '.join(f'{n} of {name!r}' for name, n in sorted(scarce.items())))
    return counts


def evaluate_splits(x: FloatArray, labels: Sequence[str], groups: Sequence[str],
                    axes: tuple[str, ...], unit: str, n_splits: int = 20,
                    progress: Any = iter) -> Evaluation:
    """Train and test on stratified random splits.

    `progress` wraps the range of splits. Raises the errors of `train`, and LabelsError if no class
    has enough examples for a test part.
    """
    check_labels(labels, groups)
    y, g = np.array(labels), np.array(groups)
    parts = []
    for seed in progress(range(n_splits)):
        train_rows, test_rows = _random_split(y, g, seed)
        model = train(x[train_rows], y[train_rows].tolist(), g[train_rows].tolist(), axes, unit,
                      seed)
        parts.append((model, x[test_rows], y[test_rows]))
    return _evaluate_parts(parts)


def evaluate(model: SignatureModel, x: FloatArray, labels: Sequence[str]) -> Evaluation:
    """Evaluate a trained model; raises LabelsError if a label is not a class of the model."""
    labels_without_class = sorted(set(labels) - set(model.classes))
    if labels_without_class:
        raise LabelsError('the model has no classes for the labels '
                          f'{", ".join(map(repr, labels_without_class))}; '
                          f'its classes are {", ".join(model.classes)}')
    return _evaluate_parts([(model, x, np.array(labels))])


def _evaluate_parts(parts: Sequence[tuple[SignatureModel, FloatArray, Any]]) -> Evaluation:
    """Evaluate each model on its test set (features, labels)."""
    classes = parts[0][0].classes
    accuracy, recall, unknown, probability, correct = [], [], [], [], []
    for model, x, y in parts:
        p, names = model.posterior(x), np.array(model.names(x))
        accuracy.append(float(np.mean(names == y)))
        recall.append([float(np.mean(names[y == c] == c)) if (y == c).any() else np.nan
                       for c in classes])
        unknown.append(float(np.mean(names == UNKNOWN)))
        probability += p.max(axis=1).tolist()
        correct += (np.array(classes)[p.argmax(axis=1)] == y).tolist()
    y = np.concatenate([part[2] for part in parts])
    recalls = np.array(recall)
    return Evaluation(classes, len(parts[0][2]), max(Counter(y.tolist()).values()) / len(y),
                      np.array(accuracy), np.nanmean(recalls, axis=1), recalls, np.array(unknown),
                      expected_calibration_error(np.array(probability), np.array(correct)))


def expected_calibration_error(probability: FloatArray, correct: FloatArray) -> float:
    """Expected calibration error over ten equal-width bins of the probability."""
    bins = np.minimum((probability * 10).astype(int), 9)
    return float(sum(abs(probability[bins == b].mean() - correct[bins == b].mean())
                     * np.mean(bins == b) for b in np.unique(bins)))


def _candidates() -> list[tuple[str, Any]]:
    """List the candidate classifiers as (name, function that creates an estimator)."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.linear_model import LogisticRegression

    return [('linear discriminant analysis',
             partial(LinearDiscriminantAnalysis, solver='lsqr', shrinkage='auto')),
            *((f'logistic regression, C = {c:g}', partial(LogisticRegression, C=c, max_iter=5000))
              for c in PENALTIES)]


def _weights_and_offsets(fitted: Any, n_classes: int) -> tuple[FloatArray, FloatArray]:
    """Weights (n_classes, n_features) and offsets (n_classes,) of a fitted estimator."""
    weights, offsets = np.asarray(fitted.coef_), np.asarray(fitted.intercept_)
    if n_classes == 2:
        weights, offsets = np.vstack([-0.5 * weights, 0.5 * weights]), \
            np.concatenate([-0.5 * offsets, 0.5 * offsets])
    return weights, offsets


def _folds(y: IntArray, groups: Sequence[str], n: int, seed: int) -> Any:
    """Stratified folds without splitting groups, as pairs of training and test indices."""
    try:
        from sklearn.model_selection import StratifiedGroupKFold
    except ImportError as error:
        raise MissingDependencyError('the classifier requires scikit-learn: pip install '
                                     '"mag_tracking[classes]"') from error
    return StratifiedGroupKFold(n, shuffle=True, random_state=seed).split(
        np.zeros(len(y)), y, np.array(groups))


def _random_split(y: Any, groups: Any, seed: int) -> tuple[IntArray, IntArray]:
    """Split each class at random without splitting groups; return (training, test) indices."""
    rng, test_groups = np.random.default_rng(seed), set[str]()
    for name in np.unique(y):
        class_groups = rng.permutation(np.unique(groups[y == name]))
        # At least `MIN_SAMPLES` examples must remain in the training part.
        n = min(max(1, round(TEST_FRACTION * len(class_groups))),
                max(len(class_groups) - MIN_SAMPLES, 0))
        test_groups |= set(class_groups[:n].tolist())
    is_test = np.isin(groups, list(test_groups))
    if not is_test.any():
        raise LabelsError('too few examples for a test set: at least one class requires more than '
                          f'{MIN_SAMPLES} examples')
    return np.flatnonzero(~is_test), np.flatnonzero(is_test)


def _class_statistics(z: FloatArray, y: IntArray) -> tuple[FloatArray, FloatArray]:
    """Compute the class centres (n_classes, n_features) and the inverse within-class covariance."""
    from sklearn.covariance import ledoit_wolf

    centres = np.array([z[y == k].mean(axis=0) for k in range(int(y.max()) + 1)])
    covariance, _ = ledoit_wolf(z - centres[y])
    return centres, np.linalg.inv(covariance + 1e-6 * np.eye(z.shape[1]))


def _squared_distances(z: FloatArray, centres: FloatArray, precision: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances (n, n_classes) to the class centres."""
    e = z[:, None] - centres
    distances: FloatArray = np.einsum('nci,ij,ncj->nc', e, precision, e)
    return distances
