"""Posterior probabilities of classes whose features are log-normal."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray

UNKNOWN = 'unknown'
SIGNIFICANCE_LEVEL = 0.01
"""Something that is less probable than this under every class is of an unknown one."""


class Feature(NamedTuple):
    """A positive number that was measured, and its law in each class."""

    value: float
    std: float
    medians: Sequence[float]
    """One per class."""
    spreads: Sequence[float]
    """Standard deviations of the natural logarithm, one per class."""


class ClassPosterior(NamedTuple):
    """Classes of one object."""

    name: str
    """The most probable class; `UNKNOWN` for an object that fits none."""
    probabilities: FloatArray
    """(n_classes,) in the order of the names."""


def class_posterior(names: Sequence[str], shares: Sequence[float],
                    features: Sequence[Feature]) -> ClassPosterior:
    """Class of an object by independent features.

    Parameters
    ----------
    names : sequence of str
    shares : sequence of float
        Prior weights, one per class.
    features : sequence of Feature

    Returns
    -------
    ClassPosterior
    """
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
