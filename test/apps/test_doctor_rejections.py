"""Advice of the doctor for every cause of rejected readings."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.apps.doctor import Doctor
from mag_tracking.apps.doctor_rejections import (
    ADVICE,
    RejectionCause,
    rejection_advice,
    rejection_cause,
)
from mag_tracking.calibration import core
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.calibrate.stage import CAUSES, Calibrate
from mag_tracking.stages.stage import rejected
from support.networks import line_network
from support.samples import MagSample, one

SETTINGS = settings_for('vehicle', {'calibrate.trust_covariances': True}).calibrate
STEP_NS = 10_000_000


def test_every_cause_has_advice():
    assert set(ADVICE) == set(RejectionCause) and all(ADVICE.values())


def test_every_rejection_code_of_the_stage_is_a_cause():
    codes = {*range(core.DONE + 1, core.STUCK + 1), *CAUSES, core.SPIKES}
    assert codes == {int(cause) for cause in RejectionCause}


@pytest.mark.parametrize('reason', CAUSES)
def test_a_description_identifies_its_cause(reason):
    assert rejection_cause(CAUSES[reason]) is RejectionCause(reason)


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
    """Feed samples to the calibration stage; return its rejections {description: number}."""
    stage = Calibrate(network, SETTINGS)
    for sample in samples:
        stage.feed(one(sample))
    return rejected(stage.counts)


FAULTS = {
    RejectionCause.UNKNOWN_SENSOR: {'sensor': 'above'},
    RejectionCause.NO_AXIS: {'field': np.full(3, np.nan)},
    RejectionCause.INFINITE: {'field': np.array([np.inf, 0.0, 0.0])},
    RejectionCause.TOO_LARGE: {'field': np.full(3, 0.5)},
    RejectionCause.BAD_COVARIANCE: {'covariance': -np.eye(3)},
    RejectionCause.AXIS_MISSING: {'field': np.array([np.nan, 1e-5, 1e-5])},
    RejectionCause.TOO_FAR_AHEAD: {'stamp_ns': 2 * 10**18},
    RejectionCause.DUPLICATE: {'stamp_ns': 10**18 + 498 * STEP_NS},
    RejectionCause.OUT_OF_ORDER: {'stamp_ns': 10**18 + 498 * STEP_NS - STEP_NS // 2},
    RejectionCause.SPIKES: {'field': np.full(3, 2e-4)}}
"""{cause: change of a reading that makes the calibration stage reject it for this cause}."""


@pytest.mark.parametrize('cause', FAULTS, ids=lambda cause: cause.name)
def test_the_cause_of_a_rejected_reading_is_identified(cause):
    network = line_network(1)
    if cause is RejectionCause.AXIS_MISSING:
        network = dataclasses.replace(network, correction=(np.eye(3) + 0.1,))
    found = rejections(changed(quiet(510, network), 499, **FAULTS[cause]), network)
    assert {rejection_cause(description) for description in found} == {cause}, found


def test_a_stuck_sensor_is_identified():
    network = line_network(1)
    samples = quiet(2000, network)
    for k in range(1000, 2000):
        samples[k] = dataclasses.replace(samples[k], field=samples[999].field)
    found = rejections(samples, network)
    assert {rejection_cause(description) for description in found} == {RejectionCause.STUCK}, found


def test_held_readings_are_identified_as_spikes():
    network = line_network(1)
    samples = quiet(502, network)
    for k in (500, 501):
        changed(samples, k, field=samples[k].field + 5e-6)
    samples += quiet(50, network)
    (description,) = rejections(samples, network)
    assert 'possible spike' in description
    assert rejection_cause(description) is RejectionCause.SPIKES


def test_a_name_in_a_description_does_not_change_the_cause():
    advice = ADVICE[RejectionCause.UNKNOWN_SENSOR]
    assert rejection_advice('unknown sensor covariance duplicate') == advice


def test_unknown_causes_get_general_advice():
    assert rejection_cause('strange') is None
    assert rejection_advice('strange') == 'check the driver'


def test_the_doctor_gives_the_advice():
    network = line_network(1)
    doctor = Doctor(network, settings_for('vehicle'))
    for sample in changed(quiet(510, network), 499, field=np.full(3, 2e-4)):
        doctor.feed(one(sample))
    assert any('1 reading rejected: spike' in f.fault
               and f.advice == ADVICE[RejectionCause.SPIKES] for f in doctor.findings())
