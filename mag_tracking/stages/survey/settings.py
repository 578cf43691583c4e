"""Settings of the survey of orientations and clock offsets."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class SurveySettings:
    """Settings of the survey of orientations and clock offsets."""

    compass_bias_std: float = param(
        6e-7, 'Prior standard deviation, per axis, of the field that a sensor and nearby iron add '
        'to the field of the Earth; it limits the accuracy of the compass. The survey '
        'updates this prior with the biases estimated from the readings.', 'T', (1e-9, 1e-4))
    offset_std: float = param(
        5e-6, 'Standard deviation, per axis, of the constant offset of an uncalibrated sensor, '
        'including iron nearby. An offset does not affect tracks. If the background of a sensor '
        'contradicts the field of the Earth by more than this offset and the uncertainty of its '
        'orientation explain, its gain, its axes or its orientation are wrong, and its tracks are '
        'ambiguous. 0 disables this flag.', 'T', (0.0, 1e-3))
    accelerometer_bias: float = param(
        0.05, 'Assumed bias of an accelerometer, per axis. 0.05 m/s^2 tilts the estimated '
        'vertical by 0.3 degrees.',
        'm/s^2', (0.0, 5.0))
    nominal_std_deg: float = param(
        5.0, 'Standard deviation, about each axis, of the orientations in the network file, for '
        'sensors without orientation_std_deg.', 'deg', (0.06, 180.0))
    max_clock_offset_s: float = param(
        0.5, 'Maximum offset between two clocks. Separate the knocks by more than this time, at '
        'irregular intervals.', 's', (1e-3, 10.0))
    max_accelerations: int = param(
        60000, 'Maximum number of stored readings per accelerometer. The oldest are dropped.', '',
        (100, 10_000_000))
