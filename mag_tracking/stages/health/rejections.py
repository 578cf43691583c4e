"""Findings about rejected readings."""

from collections.abc import Iterator

from mag_tracking.calibration.reading_faults import describe_marks
from mag_tracking.quantities import quantity
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.diagnosis import Cause, Finding

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


def rejection_findings(name: str, calibrate: Calibrate) -> Iterator[Finding]:
    """Report the rejected readings of one sensor."""
    for (cause, description), n in calibrate.rejections.of(name).items():
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
