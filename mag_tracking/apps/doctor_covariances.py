"""Covariances of messages that contradict the noise of the readings, and their likely cause."""

from collections.abc import Iterator

import numpy as np

from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.sensor_health import Finding

CLOSE = 3.0
"""A cause is likely where it explains the difference to this factor."""

_UNITS = (('millitesla', 1e3), ('gauss', 1e4), ('microtesla', 1e6), ('nanotesla', 1e9))


def likely_cause(stated: float, measured: float) -> str:
    """Why a message may state another noise than the readings show.

    Parameters
    ----------
    stated, measured : float, T
        Standard deviations.
    """
    if abs(np.log(stated**2 / measured)) < np.log(CLOSE):
        return 'the standard deviation in place of the variance'
    exponent = 2.0 * np.log10(stated)
    is_round = abs(exponent - round(exponent)) < 1e-6
    for unit, scale in _UNITS:
        if not is_round and abs(np.log(stated / measured / scale)) < np.log(CLOSE):
            return f'the variance in {unit}^2'
    return 'a placeholder' if is_round else 'a placeholder, or another unit'


def covariance_findings(name: str, topic: str, calibrate: Calibrate) -> Iterator[Finding]:
    """`Finding` of a sensor whose messages state another noise than its readings show."""
    n, stated, measured = calibrate.overruled(name)
    if not n:
        return
    advice = (f'the measured noise was used {n} times; have the driver publish the variance in '
              'T^2, or zeros where it is unknown (calibrate.trust_covariances: true uses it '
              'unchecked)')
    known = (stated > 0.0) & np.isfinite(stated) & (measured > 0.0)
    if not known.any() or np.abs(np.log(stated[known] / measured[known])).max() < np.log(2.0):
        yield Finding(False, name, f'the covariances on {topic} are not those of the quiet '
                      'readings (not positive definite, not finite, or axes that are said to err '
                      'together)', advice)
        return
    ratio = np.full(3, -1.0)
    ratio[known] = np.abs(np.log(stated[known] / measured[known]))
    axis = int(np.argmax(ratio))
    yield Finding(
        False, name, f'the messages on {topic} state a noise of {1e9 * stated[axis]:.3g} nT, '
        f'the quiet readings show {1e9 * measured[axis]:.3g} nT '
        f'({likely_cause(float(stated[axis]), float(measured[axis]))})',
        advice)
