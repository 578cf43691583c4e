"""Readings of a sensor at rest."""

import numpy as np

SIGMA = 1.2e-8


EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])


NS = 1_000_000_000


def noise(n, seed=0):
    return EARTH + SIGMA * np.random.default_rng(seed).standard_normal((n, 3))
