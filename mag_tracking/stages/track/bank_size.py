"""Memory that the start of a track needs, limited before anything is allocated."""

import math
from collections.abc import Mapping

from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import SourceModel
from mag_tracking.stages.track.initiation_vehicle import moment_directions
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.settings import TrackSettings

MAX_BYTES = 4 << 30
"""Limit for the covariances of all starting hypotheses, and for the grid of a magnet. The peak
memory is 1.5 times as large."""
START_BYTES = 250_000_000
"""Limit for the covariances of all starting hypotheses of a track. If it requires fewer sensors,
the others are added when the track has run through the frames before its detection."""
MIN_SENSORS_AT_START = 4
"""Minimum number of sensors at the start of a track: those nearest to the sensor with the strongest
field."""
WIDER_BYTES = 100_000_000
"""Limit for the covariances of the hypotheses that are kept when the other sensors are added."""
MIN_HYPOTHESES = 100
"""Minimum number of hypotheses kept, even if they exceed `WIDER_BYTES`."""
WEIGHT_KEPT = 0.999
"""The other sensors are added only if the hypotheses that are kept have this share of the weight.
With less, the track would appear more certain than the frames allow."""
_FLOAT_BYTES = 8


def check_vehicle_bank(settings: TrackSettings, network: SensorNetwork,
                       model: SourceModel) -> None:
    """Check the memory that the hypotheses of a vehicle need.

    Parameters
    ----------
    settings : TrackSettings
    network : SensorNetwork
    model : SourceModel

    Raises
    ------
    SettingsError
        If the starting hypotheses, or `MIN_HYPOTHESES` with all sensors, exceed `MAX_BYTES`.
    """
    _check_bank('track.vehicle', _vehicle_factors(settings), settings,
                sensors_at_start(settings, network, model), model)
    n = _n_sensors(settings, network)
    size = MIN_HYPOTHESES * _FLOAT_BYTES * (
        len(model.state_names) + _states_per_sensor(settings) * n)**2
    if size > MAX_BYTES:
        raise SettingsError(f'track.max_sensors: {MIN_HYPOTHESES} hypotheses with the states of '
                            f'{n} sensors need {_gigabytes(size)} of memory; the limit is '
                            f'{_gigabytes(MAX_BYTES)}')


def _vehicle_factors(settings: TrackSettings) -> dict[str, int]:
    """Factors whose product is the number of starting hypotheses of a vehicle, by name."""
    vehicle = settings.vehicle
    return {**{name: len(getattr(vehicle, name))
               for name in ('kinds', 'arrival_names', 'lateral_offsets', 'speeds')},
            'moment directions': len(moment_directions()),
            'straight or turning': 2 if vehicle.turn_acceleration else 1}


def sensors_at_start(settings: TrackSettings, network: SensorNetwork, model: SourceModel) -> int:
    """Number of sensors with which a track starts.

    Parameters
    ----------
    settings : TrackSettings
    network : SensorNetwork
    model : SourceModel

    Returns
    -------
    int
    """
    most = _n_sensors(settings, network)
    if settings.target != 'vehicle':
        return most
    return min(most, _affordable(math.prod(_vehicle_factors(settings).values()),
                                 len(model.state_names), _states_per_sensor(settings)))


def max_sensors(observation: Observation, n_hyp: int) -> int:
    """Maximum number of sensors for a bank of a given size, within `START_BYTES`.

    Parameters
    ----------
    observation : Observation
    n_hyp : int
        Number of hypotheses.

    Returns
    -------
    int
    """
    return _affordable(n_hyp, observation.n_target, observation.n_own + 3)


def _affordable(n_hyp: int, n_target: int, n_of_sensor: int) -> int:
    """Number of sensors within `START_BYTES`, by the numbers of states of target and sensor."""
    n_states = math.isqrt(START_BYTES // (_FLOAT_BYTES * n_hyp))
    return max((n_states - n_target) // n_of_sensor, MIN_SENSORS_AT_START)


def max_hypotheses(observation: Observation, n_sensors: int) -> int:
    """Maximum number of hypotheses that are kept when a track changes to `n_sensors` sensors.

    Parameters
    ----------
    observation : Observation
    n_sensors : int

    Returns
    -------
    int
    """
    size = _FLOAT_BYTES * observation.n_states(n_sensors)**2
    return max(MIN_HYPOTHESES, WIDER_BYTES // size)


def check_magnet_bank(settings: TrackSettings, network: SensorNetwork,
                      model: SourceModel) -> None:
    """Check the memory that the grid and the hypotheses of a magnet need.

    Parameters
    ----------
    settings : TrackSettings
    network : SensorNetwork
    model : SourceModel

    Raises
    ------
    SettingsError
        If the grid or the starting hypotheses exceed `MAX_BYTES`.
    """
    magnet, n = settings.magnet, _n_sensors(settings, network)
    # Each grid point stores the derivative (3, 3) of every sensor's field with respect to the
    # moment.
    size = magnet.grid_points * n * 9 * _FLOAT_BYTES
    if size > MAX_BYTES:
        raise SettingsError(f'track.magnet.grid_points: {magnet.grid_points} points x {n} sensors '
                            f'need {_gigabytes(size)} of memory; the limit is '
                            f'{_gigabytes(MAX_BYTES)}')
    _check_bank('track.magnet', {'starts': magnet.starts}, settings, n, model)


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
            f'sensors (track.max_sensors) need {_gigabytes(size)} of memory; the limit is '
            f'{_gigabytes(MAX_BYTES)}. Reduce one of these numbers')


def _n_sensors(settings: TrackSettings, network: SensorNetwork) -> int:
    """Maximum number of sensors of a track."""
    return min(len(network), settings.max_sensors)


def _states_per_sensor(settings: TrackSettings) -> int:
    """Number of states of a sensor: background, and mounting angles and model errors if used."""
    return 3 * (1 + bool(settings.mounting_std_deg) + bool(settings.model_error_time_s))


def _gigabytes(size: int) -> str:
    """Size in decimal gigabytes, as text."""
    return f'{size / 1e9:.3g} GB'
