"""Settings of the calibration."""

from dataclasses import dataclass

from mag_tracking.settings import param


@dataclass(frozen=True)
class CalibrateSettings:
    """Settings of the calibration."""

    learn_s: float = param(
        3.0, 'Quiet time from which a background is learnt, unless it is given. Where nothing is '
        'quiet for twice as long, the most frequent level is a provisional background.',
        's', (0.1, 3600.0))
    look_ahead_s: float = param(
        300.0, 'Offline: how much of a recording is searched for the most frequent level of a '
        'sensor that has no quiet beginning; 0 = none.', 's', (0.0, 86400.0))
    memory_s: float = param(
        20.0, 'Length of the quiet stretch that level, drift and noise are fitted to.',
        's', (1.0, 36000.0))
    guard_s: float = param(
        1.5, 'How far the background stays behind, so that a slow approach does not enter it.',
        's', (0.0, 600.0))
    block_s: float = param(
        0.25, 'Samples are judged in blocks of this length.', 's', (0.01, 60.0))
    freeze_std: float = param(
        2.0, 'A block whose mean is off by this many noise deviations freezes the background.',
        '', (0.5, 1000.0))
    relearn_s: float = param(
        120.0, 'After so long frozen on a steady level, that level becomes the background '
        '(a parked car); after 10 s, or four times as long as the background was seen, if that is '
        'earlier and nothing was seen to come; after two seconds where a vehicle that stood there '
        'was seen to leave, if the sensor has 20 Hz or more. 0 = never.', 's', (0.0, 86400.0))
    max_field: float = param(
        1e-3, 'A reading above this is rejected: gauss or microtesla published as tesla is the '
        'commonest fault. Near magnets millitesla are legitimate.', 'T', (1e-6, 10.0))
    max_forward_jump_s: float = param(
        60.0, 'A stamp that is ahead by more than this has to be confirmed by the next one, else '
        'it is taken for corrupt.', 's', (1e-3, 1e9))
    spike_std: float = param(
        30.0, 'A reading, or up to three, that is off those around it by more noise deviations '
        'than this is rejected as a spike; what may be one waits for the next. Below 30 Hz, where '
        'a vehicle changes much from one to the next, it has to be larger. 0 = never.',
        '', (0.0, 1e6))
    reject_stuck: bool = param(
        True, 'Readings that stay the same, from a sensor that does not repeat itself otherwise, '
        'are rejected. Simulated sensors without noise need this to be false.')
    trust_covariances: bool = param(
        False, 'Use the covariances of the messages as they are. By default the noise that the '
        'quiet readings show is used where a message states a standard deviation that differs by '
        'more than a factor of five: many drivers publish a placeholder, or another unit.')
    decimate_to_hz: float = param(
        0.0, 'Samples of a faster sensor are low-pass filtered and thinned to about this rate '
        '(a whole share of its own; 60 dB against folding, four intervals late). 0 = no: frames '
        'average anyway.',
        'Hz', (0.0, 10000.0))
    max_resume_gap_s: float = param(
        60.0, 'A node that is started again goes on with the background that it had learnt, if by '
        'the stamps that was not longer ago; 0 = never.', 's', (0.0, 86400.0))
    max_backward_jump_s: float = param(
        1.0, 'A stamp that goes back by more than this is a restart (a looped recording): '
        'what was learnt is forgotten.', 's', (0.0, 3600.0))
