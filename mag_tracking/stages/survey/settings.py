"""Settings of the survey of orientations and clock offsets."""

from dataclasses import dataclass

from mag_tracking.settings import param

COMPASS_BIAS_STD = 6e-7
"""[T] Prior standard deviation, per axis, of the field that a sensor and nearby iron add to that of
the Earth. The survey updates this prior with the biases estimated from the readings."""


@dataclass(frozen=True)
class SurveySettings:
    """Settings of the survey of orientations and clock offsets."""

    offset_std: float = param(
        5e-6, 'Standard deviation, per axis, of the constant offset of an uncalibrated sensor, '
        'including iron nearby. An offset does not affect tracks. If the background of a sensor '
        'contradicts the field of the Earth by more than this offset and the uncertainty of its '
        'orientation explain, its gain, its axes or its orientation are wrong, and its tracks are '
        'ambiguous. 0 disables this flag.', 'T', (0.0, 1e-3))
    nominal_std_deg: float = param(
        5.0, 'Standard deviation, about each axis, of the orientations in the network file, for '
        'sensors without orientation_std_deg.', 'deg', (0.06, 180.0))
