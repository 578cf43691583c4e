"""An overloaded computer is the cause of delayed and lost readings of all sensors."""

import numpy as np
import pytest

from mag_tracking.apps.doctor import Doctor, load_findings
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.stages.health.diagnosis import Cause, Finding, ranked
from support.networks import line_network
from support.samples import MagSample, one

NS = 10**9
BEGIN = 10**18
SIGMA = 1.2e-8


def diagnoses(received, sensors=2, seconds=30.0, rate=100.0, n_kept=None):
    """Diagnoses for messages that arrive at the times `received` (sensor, times [s]) [s].

    `n_kept` is the number of messages that a queue holds while the computer does not read it.
    """
    network = line_network(sensors)
    doctor = Doctor(Pipeline(network, settings_for('vehicle'), 'calibrate'))
    rng = np.random.default_rng(0)
    messages = []
    for j, name in enumerate(network.names):
        t = np.arange(int(seconds * rate)) / rate + 0.0031 * j
        arrival = received(j, t)
        for k in range(len(t)):
            last_of_burst = np.searchsorted(arrival, arrival[k] + 0.005, 'right') - 1
            if n_kept is None or last_of_burst - k < n_kept:
                messages.append((arrival[k], j, t[k], name))
    for arrival, j, t, name in sorted(messages):
        field = network.R_sw[j] @ network.earth_field + SIGMA * rng.standard_normal(3)
        doctor.feed(one(MagSample(BEGIN + round(t * NS), name, field)),
                    BEGIN + round(arrival * NS))
    return ranked(doctor.findings())


def stalled(j, t):
    """The computer reads no message for 0.4 to 1.5 s, three times."""
    arrival = t + 0.001
    for begin, length in ((6.0, 0.4), (13.0, 1.5), (22.0, 0.9)):
        late = (t >= begin) & (t < begin + length)
        arrival[late] = begin + length + 1e-6 * np.arange(late.sum())
    return arrival


@pytest.mark.parametrize('n_kept', [None, 30])
def test_an_overloaded_computer_is_the_cause(n_kept):
    """Neither the clocks nor the recorder are to blame."""
    found = diagnoses(stalled, n_kept=n_kept)
    assert [d.finding.cause for d in found] == [Cause.OVERLOADED]
    assert '3 times, ' in found[0].finding.fault
    text = str(found[0])
    assert not any(words in text for words in ('stepped', 'use timestamps', 'queue size'))


def test_a_single_sensor_that_stalls_is_not_an_overloaded_computer():
    found = diagnoses(lambda j, t: stalled(j, t) if j else t)
    assert Cause.OVERLOADED not in [d.finding.cause for d in found]


@pytest.mark.parametrize('packet_s', [0.3, 0.5, 1.0])
def test_packets_and_pauses_are_not_an_overload(packet_s):
    in_packets = diagnoses(lambda j, t: packet_s * np.ceil(t / packet_s + 1e-6) + 1e-6 * t)
    assert Cause.OVERLOADED not in [d.finding.cause for d in in_packets]
    assert not diagnoses(lambda j, t: t + 0.001 * j)


def test_a_load_is_reported_only_if_it_explains_something():
    names = ('mag_1', 'mag_2')
    lost = [Finding(True, name, '50 readings were lost', '', Cause.LOST) for name in names]
    (overload,) = load_findings(lost, names, 9.0, 2)
    assert overload.cause is Cause.OVERLOADED and '9.0 processes' in overload.fault
    assert not list(load_findings(lost, names, 1.5, 2))
    assert not list(load_findings(lost[:1], names, 9.0, 2))
    assert not list(load_findings([], (), 9.0, 2))
