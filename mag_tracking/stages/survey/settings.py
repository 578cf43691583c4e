"""Settings of the survey."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class SurveySettings:
    """Settings of the survey."""

    compass_bias_std: float = param(
        6e-7, 'What a sensor and the iron near it add to the field of the Earth, on each axis: '
        'where a compass is wrong. What can be seen of it is counted in.', 'T', (1e-9, 1e-4))
    accelerometer_bias: float = param(
        0.05, 'What an accelerometer may be off by, on each axis; 0.05 is 0.3 degrees of tilt.',
        'm/s^2', (0.0, 5.0))
    stated_std_deg: float = param(
        5.0, 'How far a sensor may be turned from its orientation in the network file, about each '
        'axis, where the file has no orientation_std_deg.', 'deg', (0.06, 180.0))
    max_clock_offset_s: float = param(
        0.5, 'Clocks are no farther apart than this; two knocks should be, and unevenly so.',
        's', (1e-3, 10.0))
    max_accelerations: int = param(
        60000, 'Readings kept of each accelerometer, the latest.', '', (100, 10_000_000))
