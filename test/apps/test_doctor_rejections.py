"""Advice of the doctor for every cause of rejected readings."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.apps.doctor import Doctor
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.stages.calibrate.rejections import REJECTIONS
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.diagnosis import Cause
from mag_tracking.stages.health.findings import ADVICE, rejection_findings
from support.networks import line_network
from support.samples import MagSample, one

SETTINGS = settings_for('vehicle', {'calibrate.trust_covariances': True}).calibrate
STEP_NS = 10_000_000


def test_every_cause_of_rejection_has_advice():
    causes = {cause for cause, _ in REJECTIONS.values()}
    assert causes | {Cause.TOO_LARGE, Cause.SPIKES} == set(ADVICE) and all(ADVICE.values())


def quiet(n, network):
    """Return `n` samples of sensor `mag_1` at 100 Hz without a target."""
    rng = np.random.default_rng(0)
    field = network.R_sw[0] @ network.earth_field
    return [MagSample(10**18 + k * STEP_NS, 'mag_1', field + 1.2e-8 * rng.standard_normal(3))
            for k in range(n)]


def changed(samples, k, **values):
    samples[k] = dataclasses.replace(samples[k], **values)
    return samples


def rejections(samples, network):
    """Feed samples to the calibration stage; return the findings about its rejections."""
    stage = Calibrate(network, SETTINGS)
    for sample in samples:
        stage.feed(one(sample))
    return list(rejection_findings('mag_1', stage))


FAULTS = {
    Cause.NO_AXIS: {'field': np.full(3, np.nan)},
    Cause.INFINITE: {'field': np.array([np.inf, 0.0, 0.0])},
    Cause.TOO_LARGE: {'field': np.full(3, 0.5)},
    Cause.WRONG_COVARIANCE: {'covariance': -np.eye(3)},
    Cause.MISSING_AXIS: {'field': np.array([np.nan, 1e-5, 1e-5])},
    Cause.TOO_FAR_AHEAD: {'stamp_ns': 2 * 10**18},
    Cause.DUPLICATE_STAMPS: {'stamp_ns': 10**18 + 498 * STEP_NS},
    Cause.BACKWARD_STAMPS: {'stamp_ns': 10**18 + 498 * STEP_NS - STEP_NS // 2},
    Cause.SPIKES: {'field': np.full(3, 2e-4)}}
"""{cause: change of a reading that makes the calibration stage reject it for this cause}."""


@pytest.mark.parametrize('cause', FAULTS, ids=lambda cause: cause.name)
def test_the_cause_of_a_rejected_reading_is_identified(cause):
    network = line_network(1)
    if cause is Cause.MISSING_AXIS:
        network = dataclasses.replace(network, correction=(np.eye(3) + 0.1,))
    found = rejections(changed(quiet(510, network), 499, **FAULTS[cause]), network)
    assert [(f.cause, f.fault[:2]) for f in found] == [(cause, '1 ')], found


def test_a_stuck_sensor_is_identified():
    network = line_network(1)
    samples = quiet(2000, network)
    for k in range(1000, 2000):
        samples[k] = dataclasses.replace(samples[k], field=samples[999].field)
    assert [f.cause for f in rejections(samples, network)] == [Cause.STUCK]


def test_held_readings_are_identified_as_spikes():
    network = line_network(1)
    samples = quiet(502, network)
    for k in (500, 501):
        changed(samples, k, field=samples[k].field + 5e-6)
    samples += quiet(50, network)
    (finding,) = rejections(samples, network)
    assert 'possible spike' in finding.fault and finding.cause is Cause.SPIKES


def test_the_doctor_gives_the_advice():
    network = line_network(1)
    doctor = Doctor(Pipeline(network, settings_for('vehicle'), 'calibrate'))
    for sample in changed(quiet(510, network), 499, field=np.full(3, 2e-4)):
        doctor.feed(one(sample))
    assert any('1 reading rejected: spike' in f.fault
               and f.advice == ADVICE[Cause.SPIKES] for f in doctor.findings())
