"""Why a pose is ambiguous: the names that are published, and what each means."""

from collections.abc import Set

ANOTHER_PLACE = 'another_place'
ANOTHER_ARRIVAL = 'another_arrival'
NOT_SEEN_APPROACHING = 'not_seen_approaching'
SENSORS_AT_ONE_PLACE = 'sensors_at_one_place'
ONE_SENSOR = 'one_sensor'
FELT_BY_ONE_SENSOR = 'felt_by_one_sensor'
DOUBTFUL_BACKGROUND = 'doubtful_background'
SENSORS_CONTRADICT = 'sensors_contradict'
MISFIT = 'misfit'
CONTRADICTION = 'contradiction'
OVERFIT = 'overfit'
DISTURBANCE_MODEL = 'disturbance_model'
INNOVATIONS = 'innovations'
SENSORS_ROTATED = 'sensors_rotated'
HEIGHT = 'height'
OFF_THE_ROAD = 'off_the_road'
FRAMES_TOO_LONG = 'frames_too_long'
CLOCKS_APART = 'clocks_apart'
NO_STEADY_PATH = 'no_steady_path'
ANOTHER_VEHICLE = 'another_vehicle'

PERMANENT = frozenset({SENSORS_ROTATED, FRAMES_TOO_LONG, CLOCKS_APART})
"""These doubts stay: the track was bent. A state that no vehicle has may soon be right again."""

MEANINGS = {
    ANOTHER_PLACE: 'another place is still possible',
    ANOTHER_ARRIVAL: 'another arrival direction is still possible',
    NOT_SEEN_APPROACHING: 'the target was not seen approaching: it stood there, or the track began '
                          'in the tail of a lost one',
    SENSORS_AT_ONE_PLACE: 'there is one sensor, or all sensors are within two metres: range and '
                          'size are those of the settings',
    ONE_SENSOR: 'a single sensor of several measures, or did for too long',
    FELT_BY_ONE_SENSOR: 'only one sensor feels the target: range and size are those of the '
                        'settings',
    DOUBTFUL_BACKGROUND: 'the background of a sensor is doubtful',
    SENSORS_CONTRADICT: 'the sensors contradict each other, and no majority is left',
    MISFIT: 'the field does not fit the best hypothesis',
    CONTRADICTION: 'the field is less probable than 1e-5',
    OVERFIT: 'the filter fits the latest frames much better than the path of its own hypothesis',
    DISTURBANCE_MODEL: 'a smooth field of no target explains the frames about as well',
    INNOVATIONS: 'the innovations of the latest frames, or of the track, are larger than stated',
    SENSORS_ROTATED: 'the track needs sensors that are rotated by more than stated',
    HEIGHT: 'the iron is where no vehicle of the kind has it',
    OFF_THE_ROAD: 'the target passes all sensors on one side, beyond the lanes of the settings',
    FRAMES_TOO_LONG: 'the target moves too far within a frame',
    CLOCKS_APART: 'the clocks of the sensors seem to be apart, by this pass or those before',
    ANOTHER_VEHICLE: 'it is not yet certain how many vehicles there are, or where one of them is',
    NO_STEADY_PATH: 'no vehicle that accelerates and turns steadily explains the pass as a whole',
}
"""{doubt: what it means}, in the order in which they are ordered."""


def ordered(doubts: Set[str]) -> tuple[str, ...]:
    """The doubts in the order of `MEANINGS`."""
    return tuple(name for name in MEANINGS if name in doubts)
