"""Settings of the detection of targets."""

from dataclasses import dataclass

from mag_tracking.settings import USER, param


@dataclass(frozen=True)
class DetectSettings:
    """Detection settings: thresholds, hold time and background uncertainty."""

    false_alarm_probability: float = param(
        1e-3, 'Probability that a single frame of noise exceeds the threshold. The actual '
        'probability is lower if background_std is not 0.', '', (1e-12, 0.5), level=USER)
    onset_frames: int = param(
        3, 'Number of consecutive frames above the threshold that start a detection.', '',
        (1, 1000))
    hold_s: float = param(
        1.0, 'Duration for which all frames have to be quiet before a detection ends.',
        's', (0.0, 3600.0))
    background_drift: float = param(
        1e-9, 'Growth rate of the standard deviation of the background while a target prevents the '
        'background from being learnt. The growth is reset a few seconds after the target has '
        'left.', 'T/s', (0.0, 1e-3))
    background_std: float = param(
        4e-9, 'Standard deviation of the background, due to drift while it is frozen. Its '
        'square is added to the noise variance, so the actual false alarm probability is lower if '
        'the background is exact: with the defaults and two sensors with 12 nT of noise per '
        'sample, 3.5e-4 per frame of one sample (12.5 Hz) and 1.5e-7 per frame of eight samples '
        '(100 Hz). With 0, it equals false_alarm_probability.', 'T', (0.0, 1e-3))
