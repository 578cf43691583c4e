"""The memory that the start of a track takes, bounded before anything is allocated."""

import math
from collections.abc import Mapping

from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import SourceModel
from mag_tracking.stages.track.initiation_vehicle import moment_directions
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.settings import TrackSettings

MAX_BYTES = 4 << 30
"""Limit for the covariances of all starting hypotheses, and for the grid of a magnet. Peak memory
is 1.5 times as much."""
START_BYTES = 250_000_000
"""The covariances of all starting hypotheses take no more than this, if need be with fewer sensors;
the others come in when the track has run through the frames before its detection."""
MIN_SENSORS_AT_START = 4
"""Every track starts with at least this many sensors: those nearest to the strongest."""
WIDER_BYTES = 100_000_000
"""When they come in, the covariances of the hypotheses that are kept take no more than this."""
MIN_HYPOTHESES = 100
"""No fewer hypotheses are kept, even if they take more."""
WEIGHT_KEPT = 0.999
"""The other sensors come in only if the hypotheses that are kept have this share of the weight:
with less, the track would look surer than the frames allow."""
_FLOAT_BYTES = 8


def check_vehicle_bank(settings: TrackSettings, network: SensorNetwork,
                       model: SourceModel) -> None:
    """Raise SettingsError where the starting hypotheses of a vehicle take too much memory."""
    _check_bank('track.vehicle', _vehicle_factors(settings), settings,
                sensors_at_start(settings, network, model), model)
    n = _n_sensors(settings, network)
    size = MIN_HYPOTHESES * _FLOAT_BYTES * (
        len(model.state_names) + _states_per_sensor(settings) * n)**2
    if size > MAX_BYTES:
        raise SettingsError(f'track.max_sensors: {MIN_HYPOTHESES} hypotheses of a target that '
                            f'{n} sensors see need {_gigabytes(size)}, more than '
                            f'{_gigabytes(MAX_BYTES)}')


def _vehicle_factors(settings: TrackSettings) -> dict[str, int]:
    """Factors {name: number} whose product is the number of starting hypotheses of a vehicle."""
    vehicle = settings.vehicle
    return {**{name: len(getattr(vehicle, name))
               for name in ('kinds', 'arrival_names', 'lateral_offsets', 'speeds')},
            'moment directions': len(moment_directions()),
            'turning or not': 2 if vehicle.turn_acceleration else 1}


def sensors_at_start(settings: TrackSettings, network: SensorNetwork, model: SourceModel) -> int:
    """How many sensors a track starts with."""
    most = _n_sensors(settings, network)
    if settings.target != 'vehicle':
        return most
    return min(most, _affordable(math.prod(_vehicle_factors(settings).values()),
                                 len(model.state_names), _states_per_sensor(settings)))


def max_sensors(observation: Observation, n_hyp: int) -> int:
    """How many sensors so many hypotheses may have states of."""
    return _affordable(n_hyp, observation.n_target, observation.n_own + 3)


def _affordable(n_hyp: int, n_target: int, n_of_sensor: int) -> int:
    """How many sensors so many hypotheses may have states of, by how many states there are of the
    target and of each sensor."""
    n_states = math.isqrt(START_BYTES // (_FLOAT_BYTES * n_hyp))
    return max((n_states - n_target) // n_of_sensor, MIN_SENSORS_AT_START)


def max_hypotheses(observation: Observation, n_sensors: int) -> int:
    """How many are kept of a track that from now on has states of so many sensors."""
    size = _FLOAT_BYTES * observation.n_states(n_sensors)**2
    return max(MIN_HYPOTHESES, WIDER_BYTES // size)


def check_magnet_bank(settings: TrackSettings, network: SensorNetwork,
                      model: SourceModel) -> None:
    """Raise SettingsError where the grid or the hypotheses of a magnet take too much memory."""
    magnet, n = settings.magnet, _n_sensors(settings, network)
    # Each point has the derivative (3, 3) of every sensor's field by the moment.
    size = magnet.grid_points * n * 9 * _FLOAT_BYTES
    if size > MAX_BYTES:
        raise SettingsError(f'track.magnet.grid_points: {magnet.grid_points} points x {n} sensors '
                            f'need {_gigabytes(size)}, more than {_gigabytes(MAX_BYTES)}')
    _check_bank('track.magnet', {'starts': magnet.starts}, settings, n, model)


def _check_bank(group: str, factors: Mapping[str, int], settings: TrackSettings, n: int,
                model: SourceModel) -> None:
    """Compare the covariances of the product of `factors` {name: number}, with `n` sensors, with
    `MAX_BYTES`.
    """
    n_hyp = math.prod(factors.values())
    n_x = len(model.state_names) + _states_per_sensor(settings) * n
    size = n_hyp * n_x**2 * _FLOAT_BYTES
    if size > MAX_BYTES:
        product = ' x '.join(f'{name} ({number})' for name, number in factors.items())
        raise SettingsError(
            f'{group}: {n_hyp} starting hypotheses, {product}, with {n_x} states each for {n} '
            f'sensors (track.max_sensors) at the start need {_gigabytes(size)}, more than '
            f'{_gigabytes(MAX_BYTES)}')


def _n_sensors(settings: TrackSettings, network: SensorNetwork) -> int:
    """Sensors that a track uses."""
    return min(len(network), settings.max_sensors)


def _states_per_sensor(settings: TrackSettings) -> int:
    """Background, and mounting angles and model errors where they are estimated."""
    return 3 * (1 + bool(settings.mounting_std_deg) + bool(settings.model_error_time_s))


def _gigabytes(size: int) -> str:
    """A size in decimal gigabytes."""
    return f'{size / 1e9:.3g} GB'
