"""Findings about a source of readings, its sensors, and a recording without detections."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from mag_tracking.calibration.reading_faults import describe_marks
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import occurrences, quantity
from mag_tracking.stages.calibrate.field_comparison import earth_field_findings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.health import clocks
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.track.plausibility import low_rate_fault
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS

MAX_FROZEN_S = 30.0
"""Time for which a background may be frozen before it is reported [s]."""
MIN_SERIOUS = 100
"""Number of readings rejected for one cause above which results are assumed to be wrong."""
ADVICE = {
    Cause.NO_AXIS: 'check the sensor and its driver',
    Cause.INFINITE: 'check the driver',
    Cause.TOO_LARGE: 'check for gauss or microtesla published as tesla; near a magnet, raise '
                     'calibrate.max_field',
    Cause.WRONG_COVARIANCE: 'publish a covariance of zeros if the noise is unknown',
    Cause.MISSING_AXIS: 'check the sensor and its driver, or remove the correction from the '
                        'network file',
    Cause.TOO_FAR_AHEAD: 'check for a clock step or corrupt messages',
    Cause.DUPLICATE_STAMPS: 'check whether the driver publishes readings twice, or with timestamps '
                            'that are too coarse',
    Cause.BACKWARD_STAMPS: 'check for two publishers on one topic, and for a clock step',
    Cause.STUCK: 'the sensor or its driver is stuck: restart it; for simulated sensors without '
                 'noise, set calibrate.reject_stuck to false',
    Cause.SPIKES: 'check connectors, power supply and checksums; if the targets are fast, raise '
                  'calibrate.spike_std'}
"""Advice for each cause of rejection by the stage Calibrate, except those of `driver_findings`."""
MAX_MISMATCH = 3.0
"""Factor within which a likely cause must explain the ratio of declared to measured noise."""
_UNITS_PER_TESLA = (('millitesla', 1e3), ('gauss', 1e4), ('microtesla', 1e6), ('nanotesla', 1e9))
MAX_NOISE_RATIO = 3.0
"""Ratio to the scatter of readings above which a configured standard deviation is too large."""


def sensor_findings(network: SensorNetwork, calibrate: Calibrate, settings: TrackSettings,
                    missing_topics: Sequence[str], spans: Mapping[str, clocks.ClockSpan]
                    ) -> list[Finding]:
    """Findings about the sensors, without ranking, after all readings; `spans` may be unknown."""
    found = list(clocks.clock_findings(clocks.corrected(spans, network)))
    for name, topic in zip(network.names, network.absolute_topics, strict=True):
        if topic in missing_topics:
            found.append(Finding(True, name, f'no messages on {topic}', 'check the topic in the '
                                 'network file', Cause.NO_MESSAGES))
        if (fault := calibrate.timestamps.worst_fault(name)) is not None:
            found.append(clocks.timestamp_finding(name, fault))
        found += rate_findings(name, calibrate.lowest_rate(name), network, settings)
        found += driver_findings(name, calibrate)
        found += rejection_findings(name, calibrate)
        found += background_findings(name, calibrate, None)
        found += covariance_findings(name, topic, calibrate)
    return [*found, *earth_field_findings(calibrate.comparison.inconsistencies())]


def background_findings(name: str, calibrate: Calibrate, frozen_since_ns: int | None,
                        n_reported: int = 0) -> Iterator[Finding]:
    """Diagnose a background, which was relearnt and reported `n_reported` times earlier."""
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
    without_time = {fault: n for fault, n in rejected.items()
                    if fault.startswith(clocks.ZERO_STAMP)}
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


def rejection_findings(name: str, calibrate: Calibrate) -> Iterator[Finding]:
    """Report the rejected readings of one sensor."""
    for (cause, description), n in calibrate.rejections[name].items():
        if cause in ADVICE:
            yield Finding(n > MIN_SERIOUS, name,
                          f'{quantity(n, "reading")} rejected: {description}', ADVICE[cause], cause)


def driver_findings(name: str, calibrate: Calibrate) -> Iterator[Finding]:
    """Report the marks and the repeated readings of one sensor that were left out."""
    faults = calibrate.driver_faults.of(name)
    if len(faults.marks):
        n = calibrate.driver_faults.n_marked(name)
        yield Finding(False, name, f'{quantity(n, "reading has", "readings have")} the value '
                      f'{describe_marks(faults.marks)}: a mark for a missing reading', 'these '
                      'values are left out; let the driver publish NaN, or no message, if it has '
                      'no reading', Cause.NO_READING_MARK)
    if faults.repetition > 1.0:
        yield Finding(False, name, f'each reading is repeated {faults.repetition:.3g} times: the '
                      f'sensor measures at {faults.rate / faults.repetition:.3g} Hz, but is '
                      f'published at {faults.rate:.3g} Hz', 'the repetitions are left out; let the '
                      'driver publish each measurement once', Cause.REPEATED)


def likely_cause(declared: float, measured: float) -> str:
    """Probable meaning of a covariance whose std [T] is not that of quiet readings."""
    if abs(np.log(declared**2 / measured)) < np.log(MAX_MISMATCH):
        return 'the standard deviation instead of the variance'
    exponent = 2.0 * np.log10(declared)
    is_round = abs(exponent - round(exponent)) < 1e-6
    for unit, scale in _UNITS_PER_TESLA:
        if not is_round and abs(np.log(declared / measured / scale)) < np.log(MAX_MISMATCH):
            return f'the variance in {unit}^2'
    return 'a placeholder' if is_round else 'a placeholder, or another unit'


def covariance_findings(name: str, topic: str, calibrate: Calibrate) -> Iterator[Finding]:
    """Report a sensor whose messages on `topic` declare a noise that contradicts its readings."""
    n, declared, measured = calibrate.overruled_covariances(name)
    if not n:
        return
    advice = (f'the measured noise replaced {quantity(n, "covariance")}; configure the driver to '
              'publish the variance in T^2, or zeros if it is unknown '
              '(calibrate.trust_covariances: true uses the covariances unchecked)')
    is_valid = (declared > 0.0) & np.isfinite(declared) & (measured > 0.0)
    if not is_valid.any() \
            or np.abs(np.log(declared[is_valid] / measured[is_valid])).max() < np.log(2.0):
        yield Finding(False, name, f'the covariances on {topic} contradict the quiet readings '
                      '(not positive definite, not finite, or with errors correlated between axes)',
                      advice, Cause.WRONG_COVARIANCE)
        return
    log_ratio = np.full(3, -1.0)
    log_ratio[is_valid] = np.abs(np.log(declared[is_valid] / measured[is_valid]))
    axis = int(np.argmax(log_ratio))
    yield Finding(
        False, name, f'the messages on {topic} state a noise of {1e9 * declared[axis]:.3g} nT, but '
        f'quiet readings have {1e9 * measured[axis]:.3g} nT '
        f'(likely cause: {likely_cause(float(declared[axis]), float(measured[axis]))})',
        advice, Cause.WRONG_COVARIANCE)


def no_detection_reason(network: SensorNetwork, calibrate: Calibrate, detect: Detect,
                        missing_topics: Sequence[str], rejected: Mapping[str, int]) -> str | None:
    """Explain why nothing was detected in a recording without `missing_topics`, with `rejected`
    readings {cause: number}; None if a target was detected."""
    if detect.counts['onsets']:
        return None
    n_accepted = sum(calibrate.counts_of(name)['accepted'] for name in network.names)
    if not n_accepted and rejected:
        cause, n = max(rejected.items(), key=lambda item: item[1])
        return f'no reading was usable: {quantity(n, "was", "were")} rejected ({cause})'
    if not n_accepted:
        return 'there were no readings on ' + ', '.join(missing_topics or network.absolute_topics)
    if not detect.counts['frames']:
        stuck = [name for name in calibrate.unready() if calibrate.backgrounds()[name].stuck]
        if stuck:
            return f'the readings of {", ".join(stuck)} are constant (run mag-tracking doctor)'
        return (f'no background was learnt for {", ".join(calibrate.unready())}: no quiet interval '
                f'lasted for {calibrate.settings.learn_s:g} s (calibrate.learn_s); set background '
                'and noise_std in the network file')
    by_sensor = ', '.join(f'{name} {ratio:.2g}' for name, ratio in zip(
        network.names, detect.largest_excursions().tolist(), strict=True))
    return (f'the largest excursion was {detect.largest_excursion:.2g} times the threshold '
            f'({by_sensor}); {_no_detection_cause(network, calibrate, detect)}')


def _no_detection_cause(network: SensorNetwork, calibrate: Calibrate, detect: Detect) -> str:
    """Describe the probable cause of the missing detection."""
    if unready := calibrate.unready():
        return f'{", ".join(unready)} had no background and could not be used'
    for name, noise in zip(network.names, network.noise_std, strict=True):
        scatter = calibrate.backgrounds()[name].scatter_std
        is_valid = ~np.isnan(scatter)
        if noise is not None and is_valid.any() \
                and (noise / scatter)[is_valid].max() > MAX_NOISE_RATIO:
            return (f'noise_std of {name} in the network file is '
                    f'{(noise / scatter)[is_valid].max():.2g} times the scatter of its readings')
    if detect.largest_excursion > 1.0:
        return (f'it lasted for {quantity(detect.max_consecutive_above, "consecutive frame")}, but '
                f'detect.onset_frames is {detect.settings.onset_frames}')
    if calibrate.settings.trust_covariances:
        return ('the covariances in the messages, which may be too large, are used unchecked '
                '(calibrate.trust_covariances)')
    scatters = np.concatenate([b.scatter_std for b in calibrate.backgrounds().values()])
    min_scatter = float(np.min(scatters, where=~np.isnan(scatters), initial=np.inf))
    if detect.settings.background_std > MAX_NOISE_RATIO * min_scatter:
        return (f'detect.background_std ({detect.settings.background_std:.2g} T) is larger than '
                f'the noise of a reading ({min_scatter:.2g} T)')
    return ('no target came close enough, or detect.false_alarm_probability '
            f'({detect.settings.false_alarm_probability:g}) is too low')
