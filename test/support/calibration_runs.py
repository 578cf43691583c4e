"""Samples, backgrounds and stages for tests of the calibration."""

import dataclasses

import numpy as np

from mag_tracking.settings import replace
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.fed_background import FedBackground
from support.networks import line_network
from support.samples import MagSample

SIGMA = np.array([1.0e-8, 1.2e-8, 1.5e-8])


EARTH = np.array([2e-6, 1.5e-5, -4.9e-5])


def running(**changes):
    return FedBackground(**{'learn': 3.0, 'memory': 20.0, 'guard': 1.5, 'block': 0.25,
                            'freeze_std': 2.0, 'relearn': 60.0, **changes})


def feed(background, t, signal=0.0, seed=0, drift=0.0):
    rng = np.random.default_rng(seed)
    for s in t:
        extra = signal(s) if callable(signal) else signal
        background.add(s, EARTH + drift * s + extra + SIGMA * rng.standard_normal(3))


def stage(n=2, given=True, **changes):
    network = line_network(n)
    if given:
        network = dataclasses.replace(network, background=(EARTH,) * n)
    return Calibrate(network, replace(CalibrateSettings(), changes))


def sample(t, field=EARTH, sensor='mag_1', covariance=None):
    return MagSample(int(t * 1e9), sensor, np.array(field, dtype=float), covariance)
