"""Memory limits for the hypotheses of a track, checked before allocation."""

import math
from collections.abc import Mapping

from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import SourceModel
from mag_tracking.stages.track.initiation_magnet import MAX_STARTS
from mag_tracking.stages.track.initiation_vehicle import moment_directions
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.settings import TrackSettings

MAX_BYTES = 4 << 30
"""Memory above which settings are rejected [bytes]. The limit applies to the covariances of all
starting hypotheses. The peak memory is 1.5 times as large."""
START_BYTES = 250_000_000
"""Memory for the covariances with which a track starts [bytes]. If the covariances with all sensors
need more, the track starts with fewer sensors. The remaining sensors are added after the frames
before the detection if few hypotheses are then probable, otherwise later."""
MIN_SENSORS_AT_START = 4
"""Minimum number of sensors at the start of a track. The sensors nearest to the strongest field are
used."""
WIDER_BYTES = 100_000_000
"""Maximum memory of the covariances after the remaining sensors have been added [bytes]."""
MIN_HYPOTHESES = 100
"""Minimum number of retained hypotheses, even if they exceed `WIDER_BYTES`."""
MIN_WEIGHT = 0.999
"""Minimum total weight of the hypotheses that are retained when the remaining sensors are added. If
more weight were dropped, the track would appear more certain than the frames justify."""
_FLOAT_BYTES = 8


def check_vehicle_bank(settings: TrackSettings, network: SensorNetwork,
                       model: SourceModel) -> None:
    """Check the memory for the hypotheses of a vehicle; raises SettingsError if the starting
    hypotheses, or `MIN_HYPOTHESES` with the maximum number of sensors, exceed `MAX_BYTES`."""
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
            'moment directions': len(moment_directions()),
            'straight or turning': 2 if vehicle.turn_acceleration else 1}


def sensors_at_start(settings: TrackSettings, network: SensorNetwork, model: SourceModel) -> int:
    """Number of sensors with which a track starts, limited by `START_BYTES` for a vehicle."""
    n_max = _n_sensors(settings, network)
    if settings.target != 'vehicle':
        return n_max
    return min(n_max, _max_affordable_sensors(math.prod(_vehicle_factors(settings).values()),
                                              len(model.state_names), _states_per_sensor(settings)))


def max_sensors(observation: Observation, n_hyp: int) -> int:
    """Maximum number of sensors for which a bank of `n_hyp` hypotheses stays within `START_BYTES`,
    but at least `MIN_SENSORS_AT_START`."""
    return _max_affordable_sensors(n_hyp, observation.n_target, observation.n_own + 3)


def _max_affordable_sensors(n_hyp: int, n_target: int, n_per_sensor: int) -> int:
    """Maximum number of sensors of a bank within `START_BYTES`; see `max_sensors`."""
    n_states = math.isqrt(START_BYTES // (_FLOAT_BYTES * n_hyp))
    return max((n_states - n_target) // n_per_sensor, MIN_SENSORS_AT_START)


def max_hypotheses(observation: Observation, n_sensors: int) -> int:
    """Maximum number of hypotheses that a track retains when it changes to `n_sensors` sensors:
    those within `WIDER_BYTES`, but at least `MIN_HYPOTHESES`."""
    size = _FLOAT_BYTES * observation.n_states(n_sensors)**2
    return max(MIN_HYPOTHESES, WIDER_BYTES // size)


def check_magnet_bank(settings: TrackSettings, network: SensorNetwork,
                      model: SourceModel) -> None:
    """Check the memory for a magnet; raises SettingsError if the starting hypotheses exceed
    `MAX_BYTES`."""
    _check_bank('track.magnet', {'optima': MAX_STARTS}, settings, _n_sensors(settings, network),
                model)


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
