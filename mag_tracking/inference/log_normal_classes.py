"""Posterior probabilities of classes with log-normal features."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray

UNKNOWN = 'unknown'
"""Name that is returned for an object that matches no class."""
SIGNIFICANCE_LEVEL = 0.01
"""Significance level of the chi-square test; an object rejected for every class is `UNKNOWN`."""


class Feature(NamedTuple):
    """A measured positive feature and its distribution in each class."""

    value: float
    """Measured value, positive."""
    std: float
    """Standard deviation of the measurement."""
    medians: Sequence[float]
    """Median of the feature in each class."""
    spreads: Sequence[float]
    """Standard deviation of the natural logarithm of the feature in each class."""


class ClassPosterior(NamedTuple):
    """Most probable class of an object, and the probabilities of all classes."""

    name: str
    """Most probable class; `UNKNOWN` if the object matches no class."""
    probabilities: FloatArray
    """Posterior probabilities, (n_classes,), in the order of the class names."""


def class_posterior(names: Sequence[str], shares: Sequence[float],
                    features: Sequence[Feature]) -> ClassPosterior:
    """Classify an object by independent features; `shares` are the prior weights of the classes."""
    measured = np.log([f.value for f in features])
    relative = np.array([f.std / f.value for f in features])
    variance = np.square(np.array([f.spreads for f in features])) + np.square(relative)[:, None]
    centres = np.log(np.array([f.medians for f in features]))
    distance = (np.square(measured[:, None] - centres) / variance).sum(axis=0)
    log_p = np.log(np.array(shares)) - 0.5 * distance - 0.5 * np.log(variance).sum(axis=0)
    p = np.exp(log_p - log_p.max())
    best = int(np.argmax(p))
    is_known = distance.min() <= chdtri(len(features), SIGNIFICANCE_LEVEL)
    return ClassPosterior(names[best] if is_known else UNKNOWN, p / p.sum())
