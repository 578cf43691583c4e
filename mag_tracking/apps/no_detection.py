"""Why nothing was detected: the largest excursion of each sensor, and what stands in the way."""

from collections.abc import Mapping, Sequence

import numpy as np

from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.stage import Detect

TOO_LARGE = 3.0
"""A noise that is stated this many times larger than the readings scatter stands in the way."""


def no_detection_reason(network: SensorNetwork, settings: Settings, calibrate: Calibrate,
                     detect: Detect, missing_topics: Sequence[str],
                     rejected: Mapping[str, int]) -> str | None:
    """One sentence; None where something was detected.

    Parameters
    ----------
    network : SensorNetwork
    settings : Settings
    calibrate, detect : Calibrate, Detect
        The stages, after the whole recording.
    missing_topics : sequence of str
        Topics of the network that were not recorded.
    rejected : {cause: number}
        Of all readings.
    """
    if detect.counts['onsets']:
        return None
    n_accepted = sum(calibrate.counts_of(name)['accepted'] for name in network.names)
    if not n_accepted and rejected:
        cause, n = max(rejected.items(), key=lambda item: item[1])
        return f'no reading could be used: {n} were rejected ({cause})'
    if not n_accepted:
        return 'there were no readings on ' + ', '.join(
            missing_topics or network.absolute_topics)
    if not detect.counts['frames']:
        hung = [name for name in calibrate.unready() if calibrate.backgrounds()[name].stuck]
        if hung:
            return f'the readings of {", ".join(hung)} do not change (see mag-tracking doctor)'
        waiting = ', '.join(calibrate.unready())
        return (f'no background was learnt for {waiting}: the field was never steady for '
                f'{settings.calibrate.learn_s:g} s (calibrate.learn_s); give background and '
                'noise_std in the network file')
    excursions = detect.largest_excursions()
    sizes = ', '.join(f'{name} {size:.2g}' for name, size in zip(
        network.names, excursions.tolist(), strict=True))
    return (f'the largest excursion was {detect.largest_excursion:.2g} of the threshold '
            f'({sizes}); {_obstacle(network, settings, calibrate, detect)}')


def _obstacle(network: SensorNetwork, settings: Settings, calibrate: Calibrate,
              detect: Detect) -> str:
    """The setting, or the entry of the network file, that stands in the way."""
    unready = calibrate.unready()
    if unready:
        return f'{", ".join(unready)} had no background and could not be used'
    for name, noise in zip(network.names, network.noise_std, strict=True):
        scatter = calibrate.backgrounds()[name].scatter_std
        known = ~np.isnan(scatter)
        if noise is not None and known.any() and (noise / scatter)[known].max() > TOO_LARGE:
            return (f'noise_std of {name} in the network file is '
                    f'{(noise / scatter)[known].max():.2g} times what its readings scatter')
    if detect.largest_excursion > 1.0:
        return (f'it lasted for {detect.max_consecutive_above} consecutive frames, and '
                f'detect.onset_frames is {settings.detect.onset_frames}')
    if settings.calibrate.trust_covariances:
        return ('the covariances of the messages are taken as they are '
                '(calibrate.trust_covariances)')
    scatters = np.concatenate([b.scatter_std for b in calibrate.backgrounds().values()])
    quietest = float(np.min(scatters, where=~np.isnan(scatters), initial=np.inf))
    if settings.detect.background_std > TOO_LARGE * quietest:
        return (f'detect.background_std ({settings.detect.background_std:.2g} T) is larger than '
                f'the noise of a reading ({quietest:.2g} T)')
    return ('nothing louder came within reach, or detect.false_alarm_probability '
            f'({settings.detect.false_alarm_probability:g}) is too strict')
