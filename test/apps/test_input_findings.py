"""Replay, traffic, events and doctor name the same fault of the timestamps or the rate first."""

import numpy as np
import pytest

from mag_tracking.apps.doctor import examine
from mag_tracking.apps.replay import replay
from mag_tracking.apps.traffic import events, traffic
from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Readings
from mag_tracking.run import RecordingSource
from mag_tracking.stages.health.diagnosis import Cause, ranked
from support.bundled import NETWORK_FILE
from support.spoilt_runs import recorded
from support.spoilt_stamps import bursts, coarse, packets

NETWORK, SETTINGS = read_network(NETWORK_FILE), settings_for('vehicle')


def since_start(other_s):
    """Each device counts from its own start; the second one started `other_s` earlier."""
    def modify(stamps):
        return stamps - stamps[0] + 12_300_000_000
    return modify, lambda stamps: modify(stamps) + round(other_s * 1e9)


def in_milliseconds(stamps):
    return (stamps - stamps[0]) // 1_000_000 * 1_000_000_000


def in_microseconds(stamps):
    """Microseconds are written as nanoseconds."""
    return stamps[0] + (stamps - stamps[0]) // 1000


def one_clock_ahead(offset_s):
    return lambda stamps: stamps, lambda stamps: stamps + round(offset_s * 1e9)


FAULTS = {
    'whole seconds': (Cause.COARSE_STAMPS, 1, coarse(1.0)),
    'steps': (Cause.COARSE_STAMPS, 1, coarse(0.1)),
    'packets': (Cause.PACKET_STAMPS, 1, packets(10)),
    'bursts': (Cause.BURST_STAMPS, 1, bursts(10)),
    'bursts on a serial line': (Cause.BURST_STAMPS, 1, bursts(10, 3e-3)),
    'zeros': (Cause.ZERO_STAMPS, 1, np.zeros_like),
    'milliseconds': (Cause.MILLISECOND_STAMPS, 1, in_milliseconds),
    'microseconds': (Cause.MILLISECOND_STAMPS, 1, in_microseconds),
    'one clock ahead': (Cause.CLOCK_DIFFERS, 1, one_clock_ahead(0.3)),
    'one clock behind': (Cause.CLOCK_DIFFERS, 1, one_clock_ahead(-2.0)),
    'starts': (Cause.BOOT_STAMPS, 1, since_start(345.0)),
    'slow': (Cause.RATE_TOO_LOW, 100, lambda stamps: stamps)}
"""Cause, thinning, and the timestamps of both sensors, or of each, from the true times."""


@pytest.fixture(scope='module', params=FAULTS)
def spoilt(request, tmp_path_factory):
    """Return (cause, recording of a passing car with wrong timestamps)."""
    cause, every, modify = FAULTS[request.param]
    readings, messages = recorded('straight_car_right').readings, []
    for j, name in enumerate(readings.names):
        own = readings.part(np.flatnonzero(readings.sensor == j)[::every])
        stamps = (modify[j] if isinstance(modify, tuple) else modify)(own.stamp_ns)
        # The log times of bursts are those of their arrival.
        logged = stamps if cause is Cause.BURST_STAMPS else own.stamp_ns
        spoilt = Readings(own.names, own.sensor, stamps, own.field)
        contents = [content for _, content in magnetic_field_dicts(spoilt)]
        messages += zip(logged.tolist(), [f'/{name}/imu/mag'] * len(own), contents, strict=True)
    path = tmp_path_factory.mktemp('spoilt') / 'r.mcap'
    with RecordingWriter(path) as writer:
        for log_ns, topic, content in sorted(messages, key=lambda m: m[0]):
            writer.write(topic, MAGNETIC_FIELD, content, log_ns)
    return cause, path


def test_every_program_names_the_cause_first(spoilt, tmp_path):
    """No pose is unambiguous if its timestamps are wrong."""
    cause, path = spoilt
    doctor, damage = examine(RecordingSource(Recording(path), NETWORK, by_message=True), NETWORK,
                             SETTINGS)
    results = [ranked(damage + doctor.findings()),
               traffic(path, NETWORK).report.diagnoses,
               events(path, NETWORK).report.diagnoses]
    for diagnoses in results:
        # Timestamps of zero are replaced by the log time.
        assert diagnoses[0].serious == (cause is not Cause.ZERO_STAMPS)
        assert diagnoses[0].finding.cause is cause
        assert not any(d.finding.cause in {Cause.LOST, Cause.CLOCK_STEPPED, Cause.CLOCK_DIFFERS}
                       - {cause} for d in diagnoses)
    assert all(health.counts['lost'] == 0 for health in doctor.sensors.values())
    summary = replay(Recording(path), NETWORK, SETTINGS, tmp_path / 'out').summary
    assert summary['diagnoses'][0]['cause'] == cause.value
    for track in summary['tracks'] if cause is not Cause.ZERO_STAMPS else ():
        assert track['doubts'].get('wrong_timestamps') == track['poses']
    if cause in (Cause.RATE_TOO_LOW, Cause.MILLISECOND_STAMPS):
        assert not summary['tracks']
