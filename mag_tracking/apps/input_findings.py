"""Findings about the input of a program that reads a recording."""

from collections.abc import Mapping, Sequence

from mag_tracking.apps.doctor import background_findings, rate_findings, recording_findings
from mag_tracking.apps.doctor_covariances import covariance_findings
from mag_tracking.apps.doctor_rejections import driver_findings, rejection_findings
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.stages.calibrate.field_comparison import earth_field_findings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.clocks import ClockSpan, clock_findings, corrected
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.timestamps import timestamp_finding
from mag_tracking.stages.track.settings import TrackSettings


def input_findings(recording: Recording, reader: SampleReader, network: SensorNetwork,
                   calibrate: Calibrate, settings: TrackSettings) -> list[Finding]:
    """Findings about a recording and its sensors, without ranking, after its end."""
    return [*recording_findings(recording, reader), *sensor_findings(
        network, calibrate, settings, reader.missing_topics(), reader.clocks)]


def sensor_findings(network: SensorNetwork, calibrate: Calibrate, settings: TrackSettings,
                    missing_topics: Sequence[str], clocks: Mapping[str, ClockSpan]
                    ) -> list[Finding]:
    """Findings about the sensors, without ranking, after all readings.

    `clocks` are the raw timestamps and times of receipt; empty if unknown.
    """
    found = list(clock_findings(corrected(clocks, network)))
    for name, topic in zip(network.names, network.absolute_topics, strict=True):
        if topic in missing_topics:
            found.append(Finding(True, name, f'no messages on {topic}', 'check the topic in the '
                                 'network file', Cause.NO_MESSAGES))
        if (fault := calibrate.timestamps.worst_fault(name)) is not None:
            found.append(timestamp_finding(name, fault))
        found += rate_findings(name, calibrate.lowest_rate(name), network, settings)
        found += driver_findings(name, calibrate)
        found += rejection_findings(name, calibrate)
        found += background_findings(name, calibrate, None)
        found += covariance_findings(name, topic, calibrate)
    return [*found, *earth_field_findings(calibrate.field_inconsistencies())]
