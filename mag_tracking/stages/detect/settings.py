"""Settings of the detection."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class DetectSettings:
    """Settings of the detection."""

    false_alarm_probability: float = param(
        1e-3, 'Probability that a single frame of noise exceeds the threshold; the actual one is '
        'lower where background_std is not 0.',
        '', (1e-12, 0.5))
    onset_frames: int = param(
        3, 'So many frames in a row above the threshold are a target.', '', (1, 1000))
    release_probability: float = param(
        1e-2, 'A frame is quiet below the threshold that noise exceeds with this probability.',
        '', (1e-12, 0.5))
    hold_s: float = param(
        1.0, 'The target is gone after so long without a frame that is not quiet.',
        's', (0.0, 3600.0))
    background_drift: float = param(
        1e-9, 'How much more the background may be off for every second that a target has kept it '
        'from being learnt; forgotten a few seconds after the target.', 'T/s', (0.0, 1e-3))
    background_std: float = param(
        4e-9, 'What the background may be off by (drift while frozen); its variance is added to '
        'that of the noise, which lowers the false alarm probability where the background is '
        'exact. At the defaults, two sensors with 12 nT of noise a sample: 3.5e-4 a frame of '
        'one sample (12.5 Hz), 1.5e-7 of eight (100 Hz). 0 = the stated probability.',
        'T', (0.0, 1e-3))
