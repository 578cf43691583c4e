"""Settings of the tracker."""

from dataclasses import dataclass, field

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.settings import USER, param
from mag_tracking.stages.track.initiation_magnet import MagnetSettings
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings

MIXTURE, HOLD, BEST = 'mixture', 'hold', 'best'
"""Choices for the poses of an ambiguous track on topics without an ambiguity flag."""


@dataclass(frozen=True)
class TrackSettings:
    """Settings of the tracker."""

    target: str = param('vehicle', 'Kind of target: vehicle or magnet.', level=USER)
    ambiguous_poses: str = param(
        MIXTURE, 'Pose of an ambiguous track on the topics without an ambiguity flag (pose, '
        'odometry, detections_3d): the best pose with the covariance of all hypotheses (mixture), '
        'no pose (hold), or the best pose with its own covariance (best).', choices=(
            MIXTURE, HOLD, BEST), level=USER)
    single_sensor_prior: bool = param(
        False, 'Track even if the network has only one sensor, or only one measures at the start. '
        'The scale is not observable from one sensor: moment and range follow from the configured '
        'moments, heights and offsets alone. Such tracks are always ambiguous.', level=USER)
    field_error: float = param(
        0.04, 'Error of the predicted field relative to its magnitude, due to the gains and axes '
        'of the sensors and the shape of the target.',
        '', (0.0, 10.0), live=True)
    model_error_time_s: float = param(
        0.3, 'Correlation time of the model error near the target. The error is a first-order '
        'Gauss-Markov process at each sensor, so its weight does not depend on the frame period. 0 '
        'selects independent noise in every frame, which is faster with many sensors.', 's',
        (0.0, 60.0))
    background_std: float = param(
        2e-8, 'Standard deviation of each background at the start of a track.', 'T', (0.0, 1e-3),
        live=True)
    background_drift: float = param(
        1e-8, 'Random walk of each background during a track.', 'T/s^0.5', (0.0, 1e-3), live=True)
    mounting_std_deg: float = param(
        5.0, 'Standard deviation of the orientation of a sensor about each axis, relative to the '
        'network file, for sensors without orientation_std_deg. The angles are estimated with each '
        'track (to first order: at 15 degrees the field is 3 % too large). 0 disables the '
        'estimation for all sensors, which is several times faster with dozens of sensors.', 'deg',
        (0.0, 15.0), level=USER)
    min_bayes_factor: float = param(
        20.0, 'Minimum Bayes factor of a target against a disturbance. A disturbance varies '
        'smoothly, either independently at each sensor (temperature drift, a knock) or across the '
        'network (geomagnetic storm, power line). The pose is ambiguous if the Bayes factor of the '
        'whole track is below this value, or falls by this factor within one second.', '',
        (1.0, 1e12), live=True)
    iterations: int = param(
        1, 'Number of linearisations per update. More than one helps if the field is far more '
        'informative than the prediction (magnets). For vehicles, further iterations may converge '
        'to the wrong side of the sensor.', '', (1, 20), live=True)
    max_sensors: int = param(
        16, 'Maximum number of sensors of a track. In a larger network, a track uses the nearest '
        'sensors. After a change of sensors, the track is not smoothed at its end. For the initial '
        'hypotheses of a vehicle, the memory limit (250 MB) may allow only about ten sensors. The '
        'remaining sensors are then added at the detection or as the vehicle moves. If they are '
        'added at the detection, smoothing begins there.', '', (2, 1000), level=USER)
    max_joint_targets: int = param(
        4, 'Maximum number of vehicles with overlapping fields that are tracked jointly. '
        'Each additional vehicle adds computing time. 1 disables joint tracking.', '', (1, 4))
    max_hypotheses: int = param(
        1200, 'Maximum number of hypotheses. The heaviest are retained.', '', (1, 100000),
        live=True)
    relinearise_window_s: float = param(
        2.0, 'Duration of the window over which the leading hypotheses of a running track are '
        'relinearised along their smoothed paths. It covers one to two times this duration, and at '
        'most 64 frames. 0 disables relinearisation, which reduces the computing time by a fifth.',
        's', (0.0, 60.0))
    cross_check: bool = param(
        True, 'Fit a path of steady acceleration and turn rate to the whole pass once a vehicle '
        'has passed, and about four times after that. The fit reveals clock offsets, clipped '
        'sensors, and two vehicles that are tracked as one. If a straight path explains the pass '
        'but leads to another position, the covariance covers this position, too.', live=True)
    lookback_s: float = param(
        1.0, 'A track begins with the stored frames of this duration before the detection. Fields '
        'that are too weak for a detection still contain information about the origin of the '
        'target.', 's', (0.0, 60.0))
    end_std: float = param(
        5.0, 'Standard deviation of the horizontal position of the best hypothesis above which a '
        'track ends as out of reach, unless the target approaches the sensors.',
        'm', (1e-6, 1e6), live=True)
    end_nis: float = param(
        25.0, 'Normalised innovation squared per axis above which a track ends after two '
        'consecutive frames, because it has lost its target. A single such frame makes the pose '
        'ambiguous. The pose of a vehicle is also ambiguous if the probability of its innovation '
        'is below 1e-5. With one or two sensors, the whole track is then ambiguous.', '',
        (1.0, 1e12), live=True)
    end_gap_s: float = param(
        2.0, 'Maximum gap between frames. A track ends at a longer gap.', 's', (1e-3, 86400.0))
    max_smoothing_s: float = param(
        60.0, 'Maximum duration of a track that is smoothed as a whole when it ends. Smoothing '
        'takes about 50 µs per frame, more with many sensors. 0 disables smoothing.', 's',
        (0.0, 86400.0))
    smoothing_lag_s: float = param(
        0.0, 'Lag of the fixed-lag smoothing. Each pose of a running track is published again '
        'after this time, with the information of the frames since. Every frame then '
        'takes about 50 µs longer for each frame of the lag. 0 disables fixed-lag smoothing.',
        's', (0.0, 10.0), level=USER)
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    magnet: MagnetSettings = field(default_factory=MagnetSettings)


def acceleration_density(settings: TrackSettings) -> FloatArray:
    """Spectral density (3,) of the acceleration that the tracker assumes, m²/s³."""
    if settings.target == 'magnet':
        return np.full(3, settings.magnet.acceleration**2)
    v = settings.vehicle
    return np.square([v.acceleration, v.acceleration, v.climb_acceleration])
