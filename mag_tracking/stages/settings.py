"""Settings of the stages from the readings to the detection of targets."""

from dataclasses import dataclass

from mag_tracking.settings import USER, param


@dataclass(frozen=True)
class CalibrateSettings:
    """Settings of backgrounds, noise, rejection of readings and decimation."""

    learn_s: float = param(
        3.0, 'Duration of the quiet interval from which a background is learnt, unless the '
        'network file contains one. If there is no quiet interval within twice this time, the most '
        'frequent level becomes a provisional background.', 's', (0.1, 3600.0), level=USER)
    relearn_s: float = param(
        120.0, 'Time after which a steady new level becomes the background (a parked car). If no '
        'target was observed approaching, the time is reduced to four times the duration for '
        'which the background was observed, but not below 10 s. If a parked vehicle was observed '
        'leaving, the time is 2 s for sensors of at least 20 Hz. 0 disables relearning.',
        's', (0.0, 86400.0), level=USER)
    max_field: float = param(
        1e-3, 'Maximum absolute value of a field component. Larger readings are rejected, because '
        'gauss or microtesla published as tesla is the most common fault. Near magnets, fields of '
        'millitesla are legitimate.', 'T', (1e-6, 10.0), level=USER)
    spike_std: float = param(
        30.0, 'Threshold for spikes, in standard deviations of the noise. Up to three consecutive '
        'readings that differ from their neighbours by more than this are rejected. A possible '
        'spike is held back until the next reading. Below 30 Hz a larger value is needed, because '
        'the field of a vehicle changes more between readings. 0 disables the check.',
        '', (0.0, 1e6))
    reject_stuck: bool = param(
        True, 'Reject unchanging readings of a sensor that does not normally repeat its readings. '
        'Set to false for simulated sensors without noise.')
    trust_covariances: bool = param(
        False, 'Use the covariances of the messages unchanged. By default, if a standard deviation '
        'in a message differs by more than a factor of five from the noise measured in quiet '
        'intervals, the measured noise is used, because many drivers publish a placeholder, or '
        'a value in another unit.')
    decimate_to_hz: float = param(
        0.0, 'Approximate rate to which faster sensors are low-pass filtered and decimated: an '
        'integer fraction of the rate of the sensor, with 60 dB of alias rejection and a delay of '
        'four output intervals. 0 disables decimation; frames average the samples in any case.',
        'Hz', (0.0, 10000.0), level=USER)
    max_resume_gap_s: float = param(
        60.0, 'Maximum gap in the timestamps of a sensor, caused by a restart of a node, after '
        'which the learnt background is restored. 0 disables restoration.',
        's', (0.0, 86400.0))


@dataclass(frozen=True)
class AlignSettings:
    """Settings of the alignment of samples into frames."""

    period_s: float = param(
        0.0, 'Frame period. The samples of each sensor within a frame are averaged. 0 '
        'selects the period automatically: in a network that spans less than two metres, half the '
        'time that a target at 20 m/s takes between the two closest sensors (0.02 to 0.08 s); '
        'otherwise 0.08 s.', 's', (0.0, 60.0), level=USER)
    burst: bool = param(
        False, 'Set to true if the sensors are read one after the other, one sample each. A frame '
        'is then complete as soon as every sensor has delivered a sample, and period_s is the '
        'maximum duration of a round.', level=USER)
    max_wait_s: float = param(
        0.5, 'Maximum time that frames wait for a sensor. A sensor that is silent for longer is '
        'treated as inactive and no longer delays frames.', 's', (1e-3, 3600.0), level=USER)
    max_clock_jump_s: float = param(
        0.5, 'Maximum forward jump of the timestamps of one sensor. The samples after a '
        'larger jump are held back until the other sensors follow; otherwise they are rejected '
        'because of a clock step. 0 disables the check.', 's', (0.0, 3600.0))
    max_buffered: int = param(
        10000, 'Maximum number of buffered samples per sensor. If it is exceeded, the oldest '
        'samples are rejected.', '', (2, 10_000_000))


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
