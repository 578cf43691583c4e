"""Findings about a source of readings and its sensors."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import occurrences
from mag_tracking.stages.calibrate.field_comparison import earth_field_findings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.clocks import ClockSpan, clock_findings, corrected
from mag_tracking.stages.health.covariances import covariance_findings
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.rejections import driver_findings, rejection_findings
from mag_tracking.stages.health.timestamps import timestamp_finding
from mag_tracking.stages.track.plausibility import low_rate_fault
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS

MAX_FROZEN_S = 30.0
"""Time for which a background may be frozen before it is reported [s]."""

ZERO_STAMP = 'message with header.stamp 0'
"""Cause for which a message without a timestamp is rejected."""


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


def background_findings(name: str, calibrate: Calibrate, frozen_since_ns: int | None,
                        n_reported: int = 0) -> Iterator[Finding]:
    """Diagnose the background of a sensor, frozen since `frozen_since_ns` or not (None).

    `n_reported` is the number of relearnt backgrounds that were reported earlier.
    """
    background, last = calibrate.backgrounds()[name], calibrate.last_stamp_ns(name)
    if last is not None and not background.ready and background.stuck:
        yield Finding(True, name, 'its readings do not change, and the sensor is not used', 'move '
                      'iron near it to check whether it is stuck or too coarse; to use it, set '
                      'background and noise_std in the network file', Cause.CONSTANT)
    elif last is not None and not background.ready:
        yield Finding(True, name, 'no background was learnt', 'keep targets away during the '
                      'first seconds, or set background and noise_std in the network file',
                      Cause.NO_BACKGROUND)
    if background.doubtful:
        yield Finding(False, name, 'its background is doubtful, which makes tracks ambiguous',
                      'keep targets away during the first seconds, or set background and '
                      'noise_std in the network file', Cause.DOUBTFUL_BACKGROUND)
    if background.n_relearnt > n_reported:
        n_times = occurrences(background.n_relearnt - n_reported)
        yield Finding(False, name, f'its background was relearnt {n_times} after a lasting change '
                      'of the field', 'check for a parked vehicle or an object near it; '
                      'calibrate.relearn_s: 0 disables relearning', Cause.RELEARNT_BACKGROUND)
    if last is not None and frozen_since_ns is not None \
            and (last - frozen_since_ns) / NS > MAX_FROZEN_S:
        yield Finding(False, name, 'its background has been frozen for '
                      f'{(last - frozen_since_ns) / NS:.0f} s', 'remove any target near it; if the '
                      'field has changed permanently, call the service calibrate',
                      Cause.FROZEN_BACKGROUND)


def rate_findings(name: str, rate: float, network: SensorNetwork,
                  settings: TrackSettings) -> Iterator[Finding]:
    """Report a sensor whose rate [Hz; NaN or inf if unknown] is too low for tracks."""
    fault = low_rate_fault(rate, network, settings)
    if fault is not None:
        yield Finding(True, name, fault, 'raise the rate of the sensor; for parked vehicles, use '
                      'mag-tracking replay --tables events', Cause.RATE_TOO_LOW)


def source_findings(name: str, lost: Mapping[str, int],
                    rejected: Mapping[str, int]) -> list[Finding]:
    """Report the unreadable parts (`lost`) and `rejected` messages of the source `name`."""
    found = []
    without_time = {fault: n for fault, n in rejected.items() if fault.startswith(ZERO_STAMP)}
    for counts, advice, cause in (
            (lost, 'the recording is damaged; mag-tracking repair adds the missing '
             'index of a truncated file, but cannot restore lost data', Cause.DAMAGED_RECORDING),
            (without_time, 'set the timestamps in the driver', Cause.ZERO_STAMPS),
            (Counter(rejected) - Counter(without_time), 'the messages are damaged or incomplete, '
             'or their encoding or type is not supported: check the driver and the program that '
             'recorded them', Cause.UNDECODABLE)):
        if counts:
            found.append(Finding(cause is Cause.DAMAGED_RECORDING, name, ', '.join(
                f'{fault}: {n}' for fault, n in counts.items()), advice, cause))
    return found
