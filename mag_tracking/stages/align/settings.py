"""Settings of the alignment."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class AlignSettings:
    """Settings of the alignment."""

    period_s: float = param(
        0.0, 'Length of a frame: the samples of each sensor in it are averaged. 0 = auto: 0.08; '
        'with sensors that are all within two metres half of what a target of 20 m/s needs between '
        'the closest, but not below 0.02.', 's', (0.0, 60.0))
    burst: bool = param(
        False, 'The sensors are read in turn, one sample each: a frame is closed as soon as '
        'every sensor has given one, and period_s is the longest that a round may take.')
    max_wait_s: float = param(
        0.5, 'A sensor that is silent for longer is taken for dead and delays nobody.',
        's', (1e-3, 3600.0))
    max_clock_jump_s: float = param(
        0.5, 'A sensor whose stamps jump ahead by more than this while those of the others do not '
        'is held back until they follow: its clock has stepped. 0 = never.', 's', (0.0, 3600.0))
    max_backward_jump_s: float = param(
        1.0, 'A stamp that goes back by more than this is a restart (a looped recording).',
        's', (0.0, 3600.0))
    max_buffered: int = param(
        10000, 'Samples held per sensor at most; more than that and the oldest are rejected.',
        '', (2, 10_000_000))
