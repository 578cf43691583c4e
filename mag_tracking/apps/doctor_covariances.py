"""Covariances in messages that contradict the noise of the readings, and their likely cause."""

from collections.abc import Iterator

import numpy as np

from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.sensor_health import Finding

MAX_MISMATCH = 3.0
"""Factor within which a likely cause must explain the difference of the noise."""

_UNITS = (('millitesla', 1e3), ('gauss', 1e4), ('microtesla', 1e6), ('nanotesla', 1e9))


def likely_cause(stated: float, measured: float) -> str:
    """Guess why the noise stated in messages differs from that of the readings.

    Parameters
    ----------
    stated : float, T
        Standard deviation according to the messages.
    measured : float, T
        Standard deviation of quiet readings.

    Returns
    -------
    str
    """
    if abs(np.log(stated**2 / measured)) < np.log(MAX_MISMATCH):
        return 'the standard deviation instead of the variance'
    exponent = 2.0 * np.log10(stated)
    is_round = abs(exponent - round(exponent)) < 1e-6
    for unit, scale in _UNITS:
        if not is_round and abs(np.log(stated / measured / scale)) < np.log(MAX_MISMATCH):
            return f'the variance in {unit}^2'
    return 'a placeholder' if is_round else 'a placeholder, or another unit'


def covariance_findings(name: str, topic: str, calibrate: Calibrate) -> Iterator[Finding]:
    """Report a sensor whose messages state another noise than its readings show.

    Parameters
    ----------
    name : str
        Sensor.
    topic : str
        Topic of its messages.
    calibrate : Calibrate

    Yields
    ------
    Finding
    """
    n, stated, measured = calibrate.overruled(name)
    if not n:
        return
    advice = (f'the measured noise was used {n} times; configure the driver to publish the '
              'variance in T^2, or zeros if it is unknown (calibrate.trust_covariances: true uses '
              'the covariances unchecked)')
    known = (stated > 0.0) & np.isfinite(stated) & (measured > 0.0)
    if not known.any() or np.abs(np.log(stated[known] / measured[known])).max() < np.log(2.0):
        yield Finding(False, name, f'the covariances on {topic} contradict the quiet readings '
                      '(not positive definite, not finite, or with correlated axes)', advice)
        return
    ratio = np.full(3, -1.0)
    ratio[known] = np.abs(np.log(stated[known] / measured[known]))
    axis = int(np.argmax(ratio))
    yield Finding(
        False, name, f'the messages on {topic} state a noise of {1e9 * stated[axis]:.3g} nT, but '
        f'quiet readings have {1e9 * measured[axis]:.3g} nT '
        f'(likely {likely_cause(float(stated[axis]), float(measured[axis]))})',
        advice)
