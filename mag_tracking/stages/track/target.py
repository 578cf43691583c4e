"""Kinds of target: source model, published orientation, start of a track and its memory limits."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import SettingsError
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import Magnet, SourceModel
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import initiation_magnet, initiation_vehicle, published_pose
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.settings import TrackSettings

MAX_BYTES = 4 << 30
"""[bytes] Maximum memory for the covariances of starting hypotheses; the peak is 1.5 times it."""
START_BYTES = 250_000_000
"""[bytes] Memory for the covariances with which a track starts. Sensors that need more are added
after the frames before the detection if few hypotheses are then probable, otherwise later."""
MIN_SENSORS_AT_START = 4
"""Minimum number of sensors at the start of a track, those nearest to the strongest field."""
WIDER_BYTES = 100_000_000
"""Maximum memory of the covariances after the remaining sensors have been added [bytes]."""
MIN_HYPOTHESES = 100
"""Minimum number of retained hypotheses, even if they exceed `WIDER_BYTES`."""
MIN_WEIGHT = 0.999
"""Minimum total weight of the hypotheses that are retained when the remaining sensors are added. If
more weight were dropped, the track would appear more certain than the frames justify."""
_FLOAT_BYTES = 8


@dataclass(frozen=True)
class Target:
    """Target that the tracker can follow: a vehicle or a magnet."""

    model: SourceModel
    orientation: published_pose.Orientation
    arrivals: Sequence[str]
    """Name of each arrival direction."""
    kinds: Sequence[str]
    """Name of each kind of target."""
    unobserved_length: Callable[[], published_pose.UnobservedLength | None]
    """Factory of the uncertainty due to unobserved length; None for a magnet."""
    starts_anywhere: bool
    """Whether a track may start anywhere, like a magnet, or on an arrival line, like a vehicle."""
    start: Callable[[TrackSettings, SensorNetwork, FieldFrame, FloatArray], FilterBank | None]
    """First hypotheses from settings, network, frame and the covariances (n_sensors, n_own, n_own)
    of mounting angles and model errors; None if the frame does not allow a start."""
    is_lost_after: Callable[[TrackSettings, SensorNetwork, float], bool] = lambda *_: False
    """Whether the target may be anywhere after a gap [s], and must start again."""


def target_of(settings: TrackSettings, network: SensorNetwork) -> Target:
    """Target that the settings select; raises SettingsError if it is unknown, if settings
    contradict each other, or if the start of a track would need too much memory."""
    if settings.target == 'vehicle':
        vehicle = settings.vehicle
        row = initiation_vehicle.vehicle_model(vehicle, network)
        _check_vehicle_bank(settings, network, row)
        return Target(row, published_pose.VehicleOrientation(), vehicle.arrival_names,
                      [kind.name for kind in vehicle.kinds],
                      partial(published_pose.UnobservedLength,
                              [kind.length for kind in vehicle.kinds],
                              [kind.length_std for kind in vehicle.kinds]), False,
                      lambda s, network, frame, own_covariance: initiation_vehicle.start_vehicle(
                          s.vehicle, network, frame, s.background_std, own_covariance))
    if settings.target == 'magnet':
        magnet = settings.magnet
        if not any(magnet.axis):
            raise SettingsError('track.magnet.axis: the zero vector has no direction')
        model = Magnet(np.full(3, magnet.acceleration**2), magnet.angular_acceleration**2)
        _check_bank('track.magnet', {'optima': initiation_magnet.MAX_STARTS}, settings,
                    _n_sensors(settings, network), model)
        return Target(model, published_pose.MagnetOrientation(np.array(magnet.axis)), ('',), ('',),
                      lambda: None, True,
                      lambda s, network, frame, own_covariance: initiation_magnet.start_magnet(
                          s.magnet, network, frame, s.background_std, own_covariance,
                          s.field_error),
                      lambda s, network, dt: initiation_magnet.is_lost_after(s.magnet, network, dt))
    raise SettingsError(f'track.target: expected vehicle or magnet, got {settings.target!r}')


def _check_vehicle_bank(settings: TrackSettings, network: SensorNetwork,
                        model: SourceModel) -> None:
    """Raise SettingsError if the hypotheses of a vehicle at the start, or later, need too much."""
    _check_bank('track.vehicle', _vehicle_factors(settings), settings,
                sensors_at_start(settings, network, model), model)
    n = _n_sensors(settings, network)
    size = MIN_HYPOTHESES * _FLOAT_BYTES * (
        len(model.state_names) + _states_per_sensor(settings) * n)**2
    if size > MAX_BYTES:
        raise SettingsError(f'track.max_sensors: {MIN_HYPOTHESES} hypotheses with the states of '
                            f'{n} sensors need {_in_gigabytes(size)} of memory; the limit is '
                            f'{_in_gigabytes(MAX_BYTES)}. Reduce track.max_sensors')


def _vehicle_factors(settings: TrackSettings) -> dict[str, int]:
    """Number of alternatives by property; their product is the number of starting hypotheses."""
    vehicle = settings.vehicle
    return {**{name: len(getattr(vehicle, name))
               for name in ('kinds', 'arrival_names', 'lateral_offsets', 'speeds')},
            'moment directions': len(initiation_vehicle.moment_directions()),
            'straight or turning': 2 if vehicle.turn_acceleration else 1}


def sensors_at_start(settings: TrackSettings, network: SensorNetwork, model: SourceModel) -> int:
    """Number of sensors with which a track starts, limited by `START_BYTES` for a vehicle."""
    n_max = _n_sensors(settings, network)
    if settings.target != 'vehicle':
        return n_max
    return min(n_max, _max_affordable_sensors(math.prod(_vehicle_factors(settings).values()),
                                              len(model.state_names), _states_per_sensor(settings)))


def max_sensors(observation: Observation, n_hyp: int) -> int:
    """Maximum number of sensors within `START_BYTES`, at least `MIN_SENSORS_AT_START`."""
    return _max_affordable_sensors(n_hyp, observation.n_target, observation.n_own + 3)


def _max_affordable_sensors(n_hyp: int, n_target: int, n_per_sensor: int) -> int:
    """Maximum number of sensors of a bank, as `max_sensors`."""
    n_states = math.isqrt(START_BYTES // (_FLOAT_BYTES * n_hyp))
    return max((n_states - n_target) // n_per_sensor, MIN_SENSORS_AT_START)


def max_hypotheses(observation: Observation, n_sensors: int) -> int:
    """Maximum number of hypotheses with `n_sensors` within `WIDER_BYTES`, or the minimum."""
    return max(MIN_HYPOTHESES, WIDER_BYTES // (_FLOAT_BYTES * observation.n_states(n_sensors)**2))


def _check_bank(group: str, factors: Mapping[str, int], settings: TrackSettings, n: int,
                model: SourceModel) -> None:
    """Raise SettingsError if the covariances of all starting hypotheses exceed `MAX_BYTES`."""
    n_hyp = math.prod(factors.values())
    n_x = len(model.state_names) + _states_per_sensor(settings) * n
    size = n_hyp * n_x**2 * _FLOAT_BYTES
    if size > MAX_BYTES:
        product = ' x '.join(f'{name} ({number})' for name, number in factors.items())
        raise SettingsError(
            f'{group}: {n_hyp} starting hypotheses, {product}, with {n_x} states each for {n} '
            f'sensors (track.max_sensors) need {_in_gigabytes(size)} of memory; the limit is '
            f'{_in_gigabytes(MAX_BYTES)}. Reduce the number of hypotheses or track.max_sensors')


def _n_sensors(settings: TrackSettings, network: SensorNetwork) -> int:
    """Maximum number of sensors of a track."""
    return min(len(network), settings.max_sensors)


def _states_per_sensor(settings: TrackSettings) -> int:
    """Number of states of a sensor: background, and mounting angles and model errors if enabled."""
    return 3 * (1 + bool(settings.mounting_std_deg) + bool(settings.model_error_time_s))


def _in_gigabytes(size: int) -> str:
    """Format a number of bytes in decimal gigabytes."""
    return f'{size / 1e9:.3g} GB'
