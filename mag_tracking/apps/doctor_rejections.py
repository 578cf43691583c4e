"""Findings about rejected readings."""

from collections.abc import Iterator

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
"""Advice for each cause of rejection by the stage Calibrate."""


def rejection_findings(name: str, calibrate: Calibrate) -> Iterator[Finding]:
    """Report the rejected readings of one sensor.

    Parameters
    ----------
    name : str
        Sensor.
    calibrate : Calibrate

    Yields
    ------
    Finding
    """
    for (cause, description), n in calibrate.rejections_of(name).items():
        yield Finding(n > MIN_SERIOUS, name, f'{quantity(n, "reading")} rejected: {description}',
                      ADVICE[cause], cause)
