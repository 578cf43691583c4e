"""Explanation of a recording without detections: largest excursions and likely cause."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.settings import DetectSettings
from mag_tracking.stages.detect.stage import Detect

MAX_NOISE_RATIO = 3.0
"""Ratio to the scatter of readings above which a configured standard deviation is too large."""


class StageSettings(Protocol):
    """Settings of the stages up to the detection."""

    @property
    def calibrate(self) -> CalibrateSettings:
        """Settings of the calibration."""

    @property
    def detect(self) -> DetectSettings:
        """Settings of the detection."""


def no_detection_reason(network: SensorNetwork, settings: StageSettings, calibrate: Calibrate,
                        detect: Detect, missing_topics: Sequence[str],
                        rejected: Mapping[str, int]) -> str | None:
    """Explain why nothing was detected.

    Parameters
    ----------
    network : SensorNetwork
    settings : StageSettings
    calibrate : Calibrate
        Calibration stage after the whole recording.
    detect : Detect
        Detection stage after the whole recording.
    missing_topics : sequence of str
        Topics of the network that were not recorded.
    rejected : {cause: number}
        Rejected readings.

    Returns
    -------
    str or None
        One sentence; None if a target was detected.
    """
    if detect.counts['onsets']:
        return None
    n_accepted = sum(calibrate.counts_of(name)['accepted'] for name in network.names)
    if not n_accepted and rejected:
        cause, n = max(rejected.items(), key=lambda item: item[1])
        return f'no reading was usable: {quantity(n, "was", "were")} rejected ({cause})'
    if not n_accepted:
        return 'there were no readings on ' + ', '.join(
            missing_topics or network.absolute_topics)
    if not detect.counts['frames']:
        stuck = [name for name in calibrate.unready() if calibrate.backgrounds()[name].stuck]
        if stuck:
            return f'the readings of {", ".join(stuck)} are constant (run mag-tracking doctor)'
        unready_names = ', '.join(calibrate.unready())
        return (f'no background was learnt for {unready_names}: no quiet interval lasted for '
                f'{settings.calibrate.learn_s:g} s (calibrate.learn_s); set background and '
                'noise_std in the network file')
    excursions = detect.largest_excursions()
    by_sensor = ', '.join(f'{name} {ratio:.2g}' for name, ratio in zip(
        network.names, excursions.tolist(), strict=True))
    return (f'the largest excursion was {detect.largest_excursion:.2g} times the threshold '
            f'({by_sensor}); {_likely_cause(network, settings, calibrate, detect)}')


def _likely_cause(network: SensorNetwork, settings: StageSettings, calibrate: Calibrate,
                  detect: Detect) -> str:
    """Describe the probable cause of the missing detection."""
    unready_sensors = calibrate.unready()
    if unready_sensors:
        return f'{", ".join(unready_sensors)} had no background and could not be used'
    for name, noise in zip(network.names, network.noise_std, strict=True):
        scatter = calibrate.backgrounds()[name].scatter_std
        is_valid = ~np.isnan(scatter)
        if noise is not None and is_valid.any() \
                and (noise / scatter)[is_valid].max() > MAX_NOISE_RATIO:
            return (f'noise_std of {name} in the network file is '
                    f'{(noise / scatter)[is_valid].max():.2g} times the scatter of its readings')
    if detect.largest_excursion > 1.0:
        frames = quantity(detect.max_consecutive_above, 'consecutive frame')
        return (f'it lasted for {frames}, but detect.onset_frames is '
                f'{settings.detect.onset_frames}')
    if settings.calibrate.trust_covariances:
        return ('the covariances in the messages, which may be too large, are used unchecked '
                '(calibrate.trust_covariances)')
    scatters = np.concatenate([b.scatter_std for b in calibrate.backgrounds().values()])
    min_scatter = float(np.min(scatters, where=~np.isnan(scatters), initial=np.inf))
    if settings.detect.background_std > MAX_NOISE_RATIO * min_scatter:
        return (f'detect.background_std ({settings.detect.background_std:.2g} T) is larger than '
                f'the noise of a reading ({min_scatter:.2g} T)')
    return ('no target came close enough, or detect.false_alarm_probability '
            f'({settings.detect.false_alarm_probability:g}) is too low')
