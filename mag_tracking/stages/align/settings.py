"""Settings of the alignment of samples into frames."""

from dataclasses import dataclass

from mag_tracking.settings import USER, param


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
