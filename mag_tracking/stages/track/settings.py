"""Settings of the tracker."""

from dataclasses import dataclass, field

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.settings import param
from mag_tracking.stages.track.initiation_magnet import MagnetSettings
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings

MIXTURE, HOLD, BEST = 'mixture', 'hold', 'best'
"""Choices for poses on topics without a flag while a track is ambiguous."""


@dataclass(frozen=True)
class TrackSettings:
    """Settings of the tracker."""

    target: str = param('vehicle', 'What moves: vehicle or magnet.')
    ambiguous_poses: str = param(
        MIXTURE, 'Poses on the topics without a flag (pose, odometry, detections_3d) while a track '
        'is ambiguous: the best pose with the covariance of all hypotheses (mixture), none (hold), '
        'or the best pose with its own covariance (best).', choices=(
            MIXTURE, HOLD, BEST))
    single_sensor_prior: bool = param(
        False, 'Track with one sensor alone (a network of one, or the only one that measures). It '
        'does not tell the scale: the moments, heights and offsets of the settings are taken for '
        'true of the targets here, and size and range follow from them alone. Such tracks are '
        'always ambiguous.')
    field_error: float = param(
        0.04, 'Error of the predicted field relative to its size: gains, axes, shape.',
        '', (0.0, 10.0), live=True)
    model_error_time_s: float = param(
        0.3, 'What the model leaves out of a field near the target stays alike for so long '
        '(first-order Gauss-Markov states of each sensor), so that what it counts does not depend '
        'on the frame period. 0 = it is noise, new in every frame, which is faster with many '
        'sensors.', 's', (0.0, 60.0))
    background_std: float = param(
        2e-8, 'What a background may be off by when a track starts.', 'T', (0.0, 1e-3), live=True)
    background_drift: float = param(
        1e-8, 'Random walk of a background during a track.', 'T/s^0.5', (0.0, 1e-3), live=True)
    mounting_std_deg: float = param(
        5.0, 'How far a sensor may be turned from its orientation in the network file, about '
        'each axis; the angles are estimated with each track (to first order: at 15 degrees the '
        'field is 3 % too long). 0 = as the file says; with dozens of sensors that is several '
        'times faster.',
        'deg', (0.0, 15.0))
    min_bayes_factor: float = param(
        20.0, 'A target has to explain the frames of its track this many times better than '
        'something else: a smooth field of each sensor\'s own (temperature, a knock), or over the '
        'network (a storm, a power line). Otherwise, or where it falls behind by this factor '
        'within a second, its pose is ambiguous.', '', (1.0, 1e12), live=True)
    iterations: int = param(
        1, 'Linearisations an update: more than one helps when the field says far more than the '
        'prediction (magnets); for vehicles it locks into the wrong side.', '', (1, 20), live=True)
    max_sensors: int = param(
        16, 'Of a larger network a track uses the nearest so many, others as it moves on; it is '
        'not smoothed then. A vehicle starts with no more of them than its first hypotheses leave '
        'memory for (250 MB), about ten; the others come in at its detection, where its smoothing '
        'begins then, or as it moves on.', '', (2, 1000))
    max_joint_targets: int = param(
        4, 'Vehicles whose fields overlap are tracked together, so many at most. Two take 2.3 '
        'times as long as one (`bench.busy`). 1 = a track is of one vehicle, whatever the frames '
        'say.', '', (1, 4))
    prune_ratio: float = param(
        1e-12, 'A hypothesis lighter than the heaviest by this ratio is dropped (T10 Alg. 3).',
        '', (1e-300, 0.5), live=True)
    max_hypotheses: int = param(
        1200, 'No more than the heaviest so many are kept.', '', (1, 100000), live=True)
    max_initial_hypotheses: int = param(
        1200, 'In the frames before the detection so many are, if that is more: they say so '
        'little of where a target comes from that of few the right one is often lost.', '',
        (1, 100000), live=True)
    relinearise_window_s: float = param(
        2.0, 'While a track runs, its leading hypotheses are linearised anew along what is now '
        'known of their path, over the latest frames (64 at most) of once to twice so much time. '
        '0 = never, which takes a fifth less time.', 's', (0.0, 60.0))
    relinearise_interval_s: float = param(
        0.15, 'How often that is done. What it takes grows with the number of sensors; with frames '
        'of 100 Hz rather choose 0.5.', 's', (0.0, 60.0))
    relinearise_max_hypotheses: int = param(
        20, 'For how many hypotheses it is done at most.', '', (1, 100000))
    cross_check: bool = param(
        True, 'Once a vehicle has passed, and about four times after that, its whole pass is '
        'fitted at once, along a path of steady acceleration and turning. That '
        'tells of clocks that are apart, of clipped sensors and of two vehicles. Where a straight '
        'path explains the pass and leads elsewhere, the covariance covers it, too.', live=True)
    lookback_s: float = param(
        1.0, 'A track begins so long before its detection, with the frames kept since: what is '
        'too weak to detect still tells where the target came from.', 's', (0.0, 60.0))
    end_std: float = param(
        5.0, 'A track ends when the horizontal position of its best hypothesis is less certain '
        'than this (one standard deviation) and no longer comes nearer: the target is out of '
        'reach.', 'm', (1e-6, 1e6), live=True)
    end_nis: float = param(
        25.0, 'A track ends when its normalised innovation is larger than this per axis, twice '
        'running: it has lost its target. Once makes it ambiguous; a vehicle is so already where '
        'the innovation is less probable than 1e-5, with two sensors for good.',
        '', (1.0, 1e12), live=True)
    end_gap_s: float = param(
        2.0, 'A track ends where the frames have a longer gap than this.', 's', (1e-3, 86400.0))
    max_smoothing_s: float = param(
        60.0, 'A track that is no longer than this is smoothed when it ends, over all of its '
        'frames, which takes a twentieth of a millisecond a frame (more with many sensors); 0 = '
        'never.', 's', (0.0, 86400.0))
    smoothing_lag_s: float = param(
        0.0, 'While a track runs, each pose is given once more when so much time has passed, by '
        'what came since; every frame then costs a twentieth of a millisecond for each frame of '
        'the lag. 0 = no.', 's', (0.0, 10.0))
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    magnet: MagnetSettings = field(default_factory=MagnetSettings)


def acceleration_density(settings: TrackSettings) -> FloatArray:
    """(3,) [m^2/s^3] spectral density of the acceleration that the tracker of these
    `TrackSettings` assumes."""
    if settings.target == 'magnet':
        return np.full(3, settings.magnet.acceleration**2)
    v = settings.vehicle
    density: FloatArray = np.square([v.acceleration, v.acceleration, v.climb_acceleration])
    return density
