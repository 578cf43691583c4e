"""Diagnosis of message covariances that contradict the noise of the readings."""

from collections.abc import Iterator

import numpy as np

from mag_tracking.quantities import quantity
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.diagnosis import Cause, Finding

MAX_MISMATCH = 3.0
"""Factor within which a likely cause must explain the ratio of declared to measured noise."""

_UNITS_PER_TESLA = (('millitesla', 1e3), ('gauss', 1e4), ('microtesla', 1e6), ('nanotesla', 1e9))


def likely_cause(declared: float, measured: float) -> str:
    """Guess why the noise std [T] declared in messages differs from that of quiet readings.

    The result is a probable meaning of the declared covariance, such as 'a placeholder'.
    """
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
