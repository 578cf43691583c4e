"""Causes of rejected readings, with the advice of `mag-tracking doctor` for each cause."""

import enum

from mag_tracking.calibration import core
from mag_tracking.stages.calibrate.stage import CAUSES


class RejectionCause(enum.IntEnum):
    """Reason why the `Calibrate` stage rejects a reading."""

    UNKNOWN_SENSOR = core.UNKNOWN_SENSOR
    NO_AXIS = core.NO_AXIS
    INFINITE = core.INFINITE
    TOO_LARGE = core.TOO_LARGE
    BAD_COVARIANCE = core.BAD_COVARIANCE
    AXIS_MISSING = core.AXIS_MISSING
    TOO_FAR_AHEAD = core.TOO_FAR_AHEAD
    DUPLICATE = core.DUPLICATE
    OUT_OF_ORDER = core.OUT_OF_ORDER
    STUCK = core.STUCK
    SPIKES = core.SPIKES


ADVICE = {
    RejectionCause.UNKNOWN_SENSOR: 'add the sensor to the network file',
    RejectionCause.NO_AXIS: 'check the sensor and its driver',
    RejectionCause.INFINITE: 'check the driver',
    RejectionCause.TOO_LARGE: 'check for gauss or microtesla published as tesla; near a magnet, '
                              'raise calibrate.max_field',
    RejectionCause.BAD_COVARIANCE: 'publish a covariance of zeros if the noise is unknown',
    RejectionCause.AXIS_MISSING: 'check the sensor and its driver, or remove the correction from '
                                 'the network file',
    RejectionCause.TOO_FAR_AHEAD: 'check for a clock step or corrupt messages',
    RejectionCause.DUPLICATE: 'check whether the driver publishes readings twice, or with '
                              'timestamps that are too coarse',
    RejectionCause.OUT_OF_ORDER: 'check for two publishers on one topic, and for a clock step',
    RejectionCause.STUCK: 'the sensor or its driver is stuck: restart it; for simulated sensors '
                          'without noise, set calibrate.reject_stuck to false',
    RejectionCause.SPIKES: 'check connectors, power supply and checksums; if the targets are fast, '
                           'raise calibrate.spike_std'}
"""Advice for each cause."""

_CAUSE_OF_DESCRIPTION = {text: RejectionCause(reason) for reason, text in CAUSES.items()}

_CAUSE_OF_PREFIX = {
    'unknown sensor ': RejectionCause.UNKNOWN_SENSOR,
    'above ': RejectionCause.TOO_LARGE,
    'spike': RejectionCause.SPIKES,
    'possible spike when ': RejectionCause.SPIKES}
"""Causes whose description contains a variable part: {start of the description: cause}."""


def rejection_cause(description: str) -> RejectionCause | None:
    """Identify a cause by its description in the counts of the stage Calibrate.

    Parameters
    ----------
    description : str
        Key of the result of `stages.stage.rejected`.

    Returns
    -------
    RejectionCause or None
        None if the description is unknown.
    """
    if description in _CAUSE_OF_DESCRIPTION:
        return _CAUSE_OF_DESCRIPTION[description]
    return next((cause for prefix, cause in _CAUSE_OF_PREFIX.items()
                 if description.startswith(prefix)), None)


def rejection_advice(description: str) -> str:
    """Return the advice for a cause of rejection, given its description.

    Parameters
    ----------
    description : str
        Key of the result of `stages.stage.rejected`.

    Returns
    -------
    str
    """
    cause = rejection_cause(description)
    return 'check the driver' if cause is None else ADVICE[cause]
