"""Doubts: the published reasons why a pose is ambiguous, and their meanings."""

from collections.abc import Mapping, Set

from mag_tracking.calibration.doubtful_times import (
    CONTRADICTS_EARTH_FIELD,
    DOUBTFUL_BACKGROUND,
    WRONG_TIMESTAMPS,
)

ANOTHER_PLACE = 'another_place'
ANOTHER_ARRIVAL = 'another_arrival'
NOT_SEEN_APPROACHING = 'not_seen_approaching'
SENSORS_AT_ONE_PLACE = 'sensors_at_one_place'
ONE_SENSOR = 'one_sensor'
FELT_BY_ONE_SENSOR = 'felt_by_one_sensor'
SENSORS_CONTRADICT = 'sensors_contradict'
MISFIT = 'misfit'
CONTRADICTION = 'contradiction'
OVERFIT = 'overfit'
DISTURBANCE_MODEL = 'disturbance_model'
INNOVATIONS = 'innovations'
SENSORS_ROTATED = 'sensors_rotated'
HEIGHT = 'height'
BELOW_SENSORS = 'below_sensors'
OFF_THE_ROAD = 'off_the_road'
FRAMES_TOO_LONG = 'frames_too_long'
CLOCKS_APART = 'clocks_apart'
NO_STEADY_PATH = 'no_steady_path'
ANOTHER_VEHICLE = 'another_vehicle'

PERMANENT = frozenset({SENSORS_ROTATED, FRAMES_TOO_LONG, CLOCKS_APART})
"""Doubts that persist until the end of a track, because they show that its path is distorted."""
MEANINGS = {
    ANOTHER_PLACE: 'another position is still possible',
    ANOTHER_ARRIVAL: 'another arrival direction is still possible',
    NOT_SEEN_APPROACHING: 'the target was not seen approaching: it started near the sensors, or '
                          'the track began while the target of a lost track was still detected',
    SENSORS_AT_ONE_PLACE: 'the network has one sensor, or all sensors are within two metres: range '
                          'and moment are not observable and follow from the settings',
    ONE_SENSOR: 'only one of several sensors provides readings, or did so for more than 0.5 s of '
                'the track',
    FELT_BY_ONE_SENSOR: 'only one sensor senses the target: range and moment are not observable '
                        'and follow from the settings',
    DOUBTFUL_BACKGROUND: 'the background of a sensor is doubtful',
    CONTRADICTS_EARTH_FIELD: 'a sensor contradicts the Earth\'s field: its axes, its gain or its '
                             'orientation in the network file are wrong',
    WRONG_TIMESTAMPS: 'the timestamps of a sensor are wrong by more than 20 ms: they are coarse, '
                      'those of packets or bursts, or those of another clock',
    SENSORS_CONTRADICT: 'the sensors contradict each other, and no majority agrees',
    MISFIT: 'the field does not fit the best hypothesis',
    CONTRADICTION: 'the probability of the field given the best hypothesis is below 1e-5',
    OVERFIT: 'the filter fits the latest frames much better than the path of its hypothesis does',
    DISTURBANCE_MODEL: 'a smooth field without a target explains the frames about as well as '
                       'the target',
    INNOVATIONS: 'the innovations of the latest frames, or of the whole track, are too large for '
                 'their covariance',
    SENSORS_ROTATED: 'the track requires larger mounting errors than configured',
    HEIGHT: 'the height of the source is implausible for its kind of vehicle',
    BELOW_SENSORS: 'the vehicle appears to pass below the sensors: two sensors are exchanged, or '
                   'the sensors are mounted upside down',
    OFF_THE_ROAD: 'the target passes all sensors on one side, outside the lanes of '
                  'track.vehicle.lateral_offsets',
    FRAMES_TOO_LONG: 'the target moves too far within one frame',
    CLOCKS_APART: 'the clocks of the sensors appear to differ in this or an earlier pass',
    ANOTHER_VEHICLE: 'the number of vehicles, or the position of one of them, is still uncertain',
    NO_STEADY_PATH: 'no path with steady acceleration and turning explains the whole pass',
}
"""Meaning of each doubt, in the order of publication."""


def applying(conditions: Mapping[str, object]) -> set[str]:
    """Doubts whose conditions are true."""
    return {name for name, applies in conditions.items() if applies}


def ordered(doubts: Set[str]) -> tuple[str, ...]:
    """Doubts in the order of `MEANINGS`."""
    return tuple(name for name in MEANINGS if name in doubts)
