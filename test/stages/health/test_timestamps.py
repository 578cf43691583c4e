"""Timestamps that are not the times of the readings are recognised, with their error."""

import numpy as np
import pytest

from mag_tracking.calibration.doubtful_times import are_doubtful
from mag_tracking.calibration.timestamps import MAX_ERROR_S, TimestampError, timestamp_fault
from mag_tracking.stages.health.clocks import (
    ClockSpan,
    TimestampMonitor,
    clock_findings,
    timestamp_finding,
)
from mag_tracking.stages.health.diagnosis import Cause
from mag_tracking.stages.health.sensor_health import SensorHealth
from mag_tracking.units import NEVER, NS
from support.spoilt_stamps import (
    EPOCH_NS,
    bursts,
    coarse,
    nanoseconds_in,
    packets,
    regular,
)

RNG = np.random.default_rng(0)
FIELDS = RNG.normal(0.0, 1e-8, (4096, 3))


def fault_of(stamps):
    return timestamp_fault(stamps, FIELDS[:len(stamps)])


SPOILT = [
    *((TimestampError.COARSE, rate, coarse(1.0)) for rate in (2.0, 8.0, 12.5, 50.0, 100.0)),
    *((TimestampError.COARSE, rate, coarse(step)) for step, rate in (
        (0.02, 100.0), (0.02, 200.0), (0.05, 8.0), (0.05, 50.0), (0.1, 8.0), (0.1, 12.5),
        (0.1, 100.0), (0.2, 25.0))),
    *((TimestampError.PACKET, 100.0, packets(n)) for n in (2, 5, 10, 25)),
    (TimestampError.PACKET, 120.0, packets(10, is_first=True)),
    *((TimestampError.BURST, 100.0, bursts(n)) for n in (2, 5, 10, 25)),
    (TimestampError.BURST, 50.0, bursts(4, 1e-3)),
    (TimestampError.UNIT, 100.0, nanoseconds_in(1e-3)),
    (TimestampError.UNIT, 100.0, nanoseconds_in(1e-6))]


@pytest.mark.parametrize('cause, rate, modify', SPOILT)
def test_a_spoilt_timestamp_has_its_cause_rate_and_error(cause, rate, modify):
    """The true times give the error: the spread of the differences from them."""
    true = regular(rate, n=300)
    stamps = modify(true)[:256]
    fault = fault_of(stamps)
    assert fault.error is cause
    assert fault.interval_s == pytest.approx(1.0 / rate, rel=0.05)
    spread_s = np.ptp(stamps - true[:256]) / NS
    # Half of a step is the error if the timestamps of a clock are not shared.
    assert 0.45 * spread_s < fault.error_s <= 1.1 * spread_s
    assert timestamp_finding('mag_1', fault).serious == (fault.error_s > MAX_ERROR_S)


@pytest.mark.parametrize('stamps', [
    *(regular(rate) for rate in (0.1, 1.0, 5.0, 8.0, 50.0, 100.0, 1000.0)),
    regular(10.0, phase_s=0.0),
    regular(100.0) + RNG.normal(0.0, 3e-3 * NS, 256).astype(np.int64),
    regular(100.0, 400)[np.sort(RNG.choice(400, 256, replace=False))],
    regular(10.0, 300, phase_s=0.0)[np.sort(RNG.choice(300, 256, replace=False))],
    # Read for a second in every ten.
    EPOCH_NS + np.arange(256) // 100 * 10 * NS + np.arange(256) % 100 * 10_000_000])
def test_regular_noisy_and_lost_timestamps_are_no_fault(stamps):
    assert fault_of(stamps) is None


def test_readings_that_are_published_twice_share_no_timestamp():
    stamps = np.repeat(regular(50.0, 128), 2)
    assert timestamp_fault(stamps, np.repeat(FIELDS[:128], 2, axis=0)) is None


def test_timestamps_of_zero_are_named():
    fault = fault_of(np.zeros(100, dtype=np.int64))
    assert fault.error is TimestampError.ZERO and timestamp_finding('mag_1', fault).serious


@pytest.mark.parametrize('size', [1, 7, 1000])
def test_the_readings_with_wrong_timestamps_are_doubtful(size):
    """Packets begin in the middle; the result does not depend on the batches."""
    true = regular(100.0, 2000)
    stamps = np.append(true[:1000], packets(10)(true)[1000:])
    names = 'mag_1', 'mag_2'
    monitor, one = TimestampMonitor(names), TimestampMonitor(names)
    rows = np.ones(len(stamps), dtype=np.int64)
    for k in range(0, len(stamps), size):
        part = slice(k, k + size)
        monitor.add(rows[part], stamps[part], FIELDS[:2000][part])
    one.add(rows, stamps, FIELDS[:2000])
    assert monitor.doubtful_times() == one.doubtful_times()
    times = monitor.doubtful_times()['mag_2']
    assert 'mag_1' not in monitor.doubtful_times()
    assert not are_doubtful(times, int(true[500])) and are_doubtful(times, int(true[1500]))
    assert monitor.worst_fault('mag_2').error is TimestampError.PACKET
    assert monitor.worst_fault('mag_1') is None


def test_the_lowest_rate_is_remembered():
    fast = regular(100.0, 1000)
    slow = fast[-1] + np.arange(1, 65) * NS
    monitor = TimestampMonitor(('mag_1',))
    stamps = np.concatenate([fast, slow, slow[-1] + regular(100.0, 1000) - EPOCH_NS])
    monitor.add(np.zeros(len(stamps), dtype=np.int64), stamps, FIELDS[:len(stamps)])
    assert monitor.lowest_rate('mag_1') == pytest.approx(1.0, rel=0.01)
    assert monitor.worst_fault('mag_1') is None


def health_of(stamps, received=None):
    """Health of a sensor; without times of receipt by default."""
    health = SensorHealth()
    for k, stamp in enumerate(stamps.tolist()):
        health.add(stamp, FIELDS[k], None if received is None else int(received[k]))
    return health


@pytest.mark.parametrize('modify', [coarse(1.0), coarse(0.1), packets(10), bursts(10)])
def test_no_reading_is_lost_and_no_clock_steps(modify):
    true = regular(100.0, 1400)
    health = health_of(modify(true), true)
    assert health.counts['lost'] == health.counts['clock steps'] == 0
    assert health.rate == pytest.approx(100.0, rel=0.02)


def test_another_rate_is_no_loss():
    fast = regular(100.0, 2000)
    health = health_of(np.append(fast, fast[-1] + np.arange(1, 41) * NS))
    assert health.counts['lost'] < 0.01 * health.counts['readings']


@pytest.mark.parametrize('lost', [0.0, 0.05])
def test_jitter_is_no_loss(lost):
    """The timestamps of a computer that is busy: in order, with a deviation of a fifth."""
    rng = np.random.default_rng(3)
    stamps = np.sort(regular(200.0, 3000) + rng.normal(0.0, 1e6, 3000).astype(np.int64))
    stamps = stamps[rng.random(len(stamps)) >= lost]
    assert health_of(stamps).counts['lost'] == pytest.approx(3000 * lost, abs=30)


def test_infinite_readings_are_neither_spikes_nor_saturated():
    fields = FIELDS[:1400].copy()
    fields[::9] = np.inf
    health = SensorHealth()
    for stamp, field in zip(regular(100.0, 1400).tolist(), fields, strict=True):
        health.add(stamp, field)
    assert health.counts['spikes'] == health.counts['saturated'] == 0


def test_identical_readings_of_a_slow_sensor_are_not_stuck():
    """At 0.1 Hz, two identical readings in a row last for ten seconds."""
    health, fields = SensorHealth(), 1e-8 * np.round(FIELDS[:400] / 1e-8)
    for stamp, field in zip(regular(0.1, 400).tolist(), fields, strict=True):
        health.add(stamp, field)
    assert health.counts['stuck readings'] == 0


def findings_of(**clocks):
    return {f.subject: f for f in clock_findings(clocks)}


def span(first_s, last_s, received_s=14.0):
    """Clock that shows `first_s` and `last_s` when `received_s` pass after the epoch."""
    return ClockSpan(round(first_s * NS), round(last_s * NS), EPOCH_NS,
                     EPOCH_NS + round(received_s * NS))


@pytest.mark.parametrize('factor, unit', [(1e3, 'milliseconds'), (1e6, 'microseconds')])
def test_the_unit_of_the_seconds_is_named(factor, unit):
    found = findings_of(mag_1=span(5.0 * factor, 19.0 * factor), mag_2=span(12.0, 26.0))
    assert found['mag_1'].cause is Cause.MILLISECOND_STAMPS and unit in found['mag_1'].fault
    assert found['mag_2'].cause is Cause.BOOT_STAMPS


@pytest.mark.parametrize('other_s, serious', [(12.4, False), (345.0, True)])
def test_clocks_since_the_start_of_the_devices_are_compared(other_s, serious):
    found = findings_of(mag_1=span(12.0, 26.0), mag_2=span(other_s, other_s + 14.0))
    assert {f.cause for f in found.values()} == {Cause.BOOT_STAMPS}
    assert any(f.serious for f in found.values()) == serious


@pytest.mark.parametrize('ahead_s, differs', [
    (0.3, True), (0.15, True), (0.05, False), (-0.15, False), (-0.3, True), (3600.0, True)])
def test_a_steady_difference_of_clocks_is_named(ahead_s, differs):
    """A delay of 0.15 s is possible, but not a receipt before the measurement."""
    found = findings_of(mag_1=span(EPOCH_NS / NS - 0.001, EPOCH_NS / NS + 13.999),
                        mag_2=span(EPOCH_NS / NS + ahead_s, EPOCH_NS / NS + 14.0 + ahead_s))
    assert [(f.subject, f.cause) for f in found.values()] == \
        [('mag_2', Cause.CLOCK_DIFFERS)] * differs


def test_a_delay_that_varies_is_no_difference_of_clocks():
    """Readings of a packet arrive together."""
    found = findings_of(mag_1=span(EPOCH_NS / NS, EPOCH_NS / NS + 14.0),
                        mag_2=span(EPOCH_NS / NS - 5.0, EPOCH_NS / NS + 13.5))
    assert not found


@pytest.mark.parametrize('received_s', [14.0, 0.1])
def test_clocks_of_a_fast_replay_are_not_compared(received_s):
    """At 80 times real time, readings that arrive 1 s apart were measured 80 s apart."""
    assert not findings_of(
        mag_1=span(EPOCH_NS / NS - 80.0 * received_s, EPOCH_NS / NS, received_s),
        mag_2=span(EPOCH_NS / NS - 80.0 * received_s + 80.0, EPOCH_NS / NS + 80.0, received_s))


def test_a_clock_without_a_time_of_receipt_is_unknown():
    assert health_of(regular(100.0)).clock is None
    received = np.full(64, NEVER)
    received[10:20] = EPOCH_NS
    assert health_of(regular(100.0, 64), received).clock.first_ns == regular(100.0)[10]
