"""Settings of the calibration of readings."""

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
