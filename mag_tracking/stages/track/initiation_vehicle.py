"""Initiation of a vehicle's track: settings, model and first hypotheses."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import SettingsError
from mag_tracking.geometry import rotation_about_z
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0, dipole_jacobians
from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.quantities import quantity
from mag_tracking.records import FieldFrame
from mag_tracking.settings import USER, param

REFERENCE_FIELD = 5e-5
"""Field for which `VehicleSettings.induced_share` is defined [T]."""
MAX_CAR_ROW = 4.0
"""[m] Maximum length of the row of dipoles of a car, beyond which the iron exceeds the row."""
LATERAL_STD, ALONG_STD = 1.5, 3.0
"""[m] Standard deviations of the starting position across and along a starting line."""
MAX_START_DISTANCE = 30.0
"""[m] Maximum starting distance from the outermost sensor."""
SPEED_STD, CROSS_SPEED_STD = 0.3, 0.1
"""Standard deviations of the velocity along and across the heading, relative to the speed."""
CLIMB_STD = 0.1
"""[m/s] Standard deviation of the vertical velocity."""
TURN_SHARE, START_TURN_RATIO = 0.5, 0.5
"""Fraction of vehicles that turn near the sensors, and initial standard deviation of their turn
rate, relative to that during a turn, because vehicles arrive along straight lines."""


@dataclass(frozen=True)
class VehicleKind:
    """Length, magnetism and height of a kind of vehicle; the defaults are those of a car."""

    name: str
    length: float = param(
        3.0, 'Initial length of the row of dipoles (TSP14 eq. (10)), which is somewhat shorter '
        'than the vehicle. 0 selects a point target. If all kinds are points, the filter is '
        'several times faster. For kinds above 4 m, the covariance of the published position '
        'allows for the part of the vehicle beyond the row.', 'm', (0.0, 1000.0), level=USER)
    length_std: float = param(
        1.0, 'Standard deviation of the length; 0 for points.', 'm', (0.0, 1000.0), level=USER)
    moment: float = param(
        400.0, 'Initial magnitude of the moment. TSP14 gives 300 to 600 for cars and about 1800 '
        'for trucks, which the default moment_std covers.', 'A m^2', (1e-6, 1e6), level=USER)
    moment_std: float = param(
        150.0, 'Standard deviation of the total hard iron moment, per axis.', 'A m^2',
        (1e-6, 1e6), level=USER)
    difference_std: float = param(
        45.0, 'Standard deviation of the dipole moments of a row about their mean, per axis; 0 for '
        'points. The iron of a vehicle is not distributed evenly.', 'A m^2', (0.0, 1e6),
        level=USER)
    height: float = param(
        0.5, 'Height of the magnetic centre above the plane z = 0 of the sensors.', 'm',
        (-100.0, 100.0), level=USER)
    height_std: float = param(
        0.2, 'Standard deviation of the height.', 'm', (1e-6, 100.0), level=USER)
    near_field_length: float = param(
        0.3, 'Near-field length (lambda in ICASSP11 eq. (9)): distance of the iron from the '
        'modelled dipoles. Near a vehicle, the model error is the first neglected multipole term.',
        'm', (0.0, 1000.0), level=USER)


@dataclass(frozen=True)
class VehicleSettings:
    """Motion, magnetism and arrival directions of vehicles."""

    arrival_names: tuple[str, ...] = param(
        ('left', 'right', 'rear'), 'Names of the arrival directions.', level=USER)
    arrival_headings_deg: tuple[float, ...] = param(
        (0.0, 180.0, 90.0), 'Heading on arrival, one per arrival name, measured anticlockwise from '
        'x. The arrival lines pass through the centre of the network.',
        'deg', (-360.0, 360.0), level=USER)
    lateral_offsets: tuple[float, ...] = param(
        (-4.0, 0.0, 4.0), 'Lateral offsets of the starting lines from each arrival line. Positive '
        'offsets are to the left of the heading.', 'm', (-1000.0, 1000.0), level=USER)
    speeds: tuple[float, ...] = param((5.0, 10.0, 20.0), 'Initial speeds.', 'm/s', (0.01, 200.0),
                                      level=USER)
    dipoles: int = param(
        5, 'Number of dipoles in the row that models a vehicle with a length. Three are '
        'sufficient for cars; a truck that passes close by is then tracked less accurately.', '',
        (2, 20))
    induced_share: float = param(
        0.4, 'Fraction of the initial moment that a field of 50 uT would induce: soft iron D = '
        'share x moment x mu0 / 50 uT along each axis of the vehicle, m = Rz (m0 + D Rz^T B0/mu0). '
        'TSP14 Tables V and VI give 0.26 for a car (three times the tabulated D); a fit to T10 '
        'Table 6.9 gives 0.42. The setting has no effect if the network has no earth field.', '',
        (0.0, 10.0))
    induced_share_std: float = param(
        0.3, 'Standard deviation of the induced share. It applies twice: in common to the three '
        'axes, and again independently to each axis. '
        'The axes of the car in MITRE12 differ by a third of their mean (RMS), '
        'which is 0.13 here; a larger value compensates for errors of the model.', '',
        (0.0, 10.0))
    acceleration: float = param(
        1.0, 'Root spectral density of the horizontal acceleration.', 'm/s^1.5', (0.0, 1000.0))
    turn_acceleration: float = param(
        3.0, 'Standard deviation of the lateral acceleration of turning hypotheses; each straight '
        'hypothesis has a turning counterpart. 0 disables turning hypotheses, which halves the '
        'number of hypotheses.', 'm/s^2', (0.0, 100.0))
    turn_time: float = param(1.5, 'Correlation time of the turn rate.', 's', (0.01, 1000.0))
    climb_acceleration: float = param(
        0.1, 'Root spectral density of the vertical acceleration.', 'm/s^1.5', (0.0, 1000.0))
    moment_drift: float = param(
        0.03, 'Random walk of the hard iron moment, relative to its magnitude. The effective '
        'moment of a vehicle depends on the side that faces the sensor.', '1/s^0.5', (0.0, 1e3))
    difference_drift: float = param(
        0.0125, 'Random walk of the dipole moments of a row about their mean, relative to the '
        'magnitude of the hard iron moment.', '1/s^0.5', (0.0, 1e3))
    kinds: tuple[VehicleKind, ...] = param(
        (VehicleKind('small', 0.0, 0.0, 120.0, 45.0, 0.0, 0.5, 0.2, 0.8), VehicleKind('car'),
         VehicleKind('truck', 9.0, 3.0, 1600.0, 600.0, 240.0, 1.0, 0.4, 0.3)),
        'Names of the kinds of vehicle; the evidence selects one per track. A new kind has the '
        'values of a car where none are given.', level=USER)


def vehicle_model(settings: VehicleSettings, network: SensorNetwork) -> RowVehicle:
    """Source model of a vehicle; raises SettingsError if there is not one heading per arrival name,
    or if a kind without length has a std of it or of the moment differences."""
    n = len(settings.arrival_names)
    if len(settings.arrival_headings_deg) != n:
        raise SettingsError(
            f'track.vehicle.arrival_headings_deg: expected {quantity(n, "value")} (one per arrival '
            f'name), got {len(settings.arrival_headings_deg)}')
    for kind in settings.kinds:
        for name in ('length_std', 'difference_std'):
            if getattr(kind, name) and not kind.length:
                raise SettingsError(f'track.vehicle.kinds.{kind.name}.{name}: '
                                    f'{getattr(kind, name):g} for a point (its length is 0); '
                                    'use 0')
    horizontal, vertical = settings.acceleration**2, settings.climb_acceleration**2
    earth_field = np.zeros(3) if network.earth_field is None else network.earth_field
    return RowVehicle(earth_field, np.array([horizontal, horizontal, vertical]),
                      settings.moment_drift, settings.difference_drift,
                      _n_dipoles(settings), settings.turn_acceleration, settings.turn_time)


def _n_dipoles(settings: VehicleSettings) -> int:
    """Number of dipoles: the setting if any kind has a length, else 1."""
    return settings.dipoles if any(kind.length for kind in settings.kinds) else 1


def _soft_iron_per_share(settings: VehicleSettings, kind: int) -> float:
    """Soft iron [m³] of a kind of vehicle for an induced share of one."""
    return settings.kinds[kind].moment * MU0 / REFERENCE_FIELD


def soft_iron(settings: VehicleSettings, kind: int) -> float:
    """Initial soft iron D of a kind of vehicle, along each axis, m³."""
    return settings.induced_share * _soft_iron_per_share(settings, kind)


def moment_directions() -> FloatArray:
    """Unit vectors (14, 3) along the axes and diagonals of a cube, with both signs."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    diagonals = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)])
    return np.vstack([axes, diagonals / np.sqrt(3.0)])


def start_vehicle(settings: VehicleSettings, network: SensorNetwork, frame: FieldFrame,
                  background_std: float, own_covariance: FloatArray) -> FilterBank:
    """Hypotheses of a vehicle at its first frame ([ICASSP11]_ section 2.2; [T10]_ Alg. 3, which has
    one per arrival), with covariances `own_covariance` (n_sensors, n_own, n_own) of each sensor.

    There is one for each combination of kind, arrival line (its label), moment direction, lateral
    offset and speed, and a turning copy of each if enabled. It starts at the first position on its
    line at which its field has the measured energy.
    """
    states, covariances = list[FloatArray](), list[FloatArray]()
    labels, kinds = list[int](), list[int]()
    model = vehicle_model(settings, network)
    energy, whitening = _measured_energy(network, frame)
    for kind, of_kind in enumerate(settings.kinds):
        moments = of_kind.moment * moment_directions()
        for label, heading in enumerate(np.deg2rad(settings.arrival_headings_deg)):
            R = rotation_about_z(heading)
            hard_iron = (moments - soft_iron(settings, kind) * model.earth_field / MU0) @ R
            velocities = np.array(settings.speeds)[:, None] * R[:, 0]
            starts = _matching_positions(settings, network, energy, whitening, R, moments,
                                         of_kind.height)
            states.append(_initial_states(settings, kind, starts, velocities, hard_iron))
            by_speed = np.array([starting_covariance(settings, kind, R, v)
                                 for v in settings.speeds])
            covariances.append(np.tile(by_speed.repeat(len(moments), 0), (len(starts), 1, 1)))
            labels += [label] * len(states[-1])
            kinds += [kind] * len(states[-1])
    bank = FilterBank.from_targets(np.vstack(states), np.vstack(covariances), np.array(labels),
                                   len(network), background_std, own_covariance, np.array(kinds))
    if not model.turn_acceleration:
        return bank
    n, w = len(bank), len(model.state_names) - 1
    doubled = bank.rows(np.tile(np.arange(n), 2))
    doubled.origin = np.arange(2 * n)
    doubled.log_w = np.log(np.repeat([1.0 - TURN_SHARE, TURN_SHARE], n) / n)
    doubled.P[n:, w, w] = START_TURN_RATIO**2 * model.turn_variance(np.hypot(*bank.x[:, 3:5].T))
    return doubled


def _measured_energy(network: SensorNetwork, frame: FieldFrame) -> tuple[float, FloatArray]:
    """Energy of the whitened field of a frame in excess of noise, which determines the initial
    distance, and rotations (n_sensors, 3, 3) from world to sensor divided by the noise [1/T]."""
    is_present = ~np.isnan(frame.field)
    energy = float(whitened_energy(frame.field, frame.covariance)[0].sum())
    std = np.sqrt(np.einsum('jii->ji', frame.covariance))
    # The expected energy of noise is one per axis.
    return (max(energy - np.count_nonzero(is_present), 1.0),
            network.R_sw / np.where(is_present, std, np.inf)[:, :, None])


def _matching_positions(settings: VehicleSettings, network: SensorNetwork, energy: float,
                        whitening: FloatArray, R: FloatArray, moments: FloatArray, height: float
                        ) -> FloatArray:
    """First position on each line at which the field of each moment reaches the measured energy,
    (n_offsets, n_moments, 3); the last one, next to the outermost sensor, if it never does."""
    along = (network.positions - network.centre) @ R[:, 0]
    distance = np.linspace(MAX_START_DISTANCE, 0.0, 160) - along.min()
    line = np.array([network.centre[0], network.centre[1], height])
    offsets = np.array(settings.lateral_offsets)
    points = line + offsets[:, None, None] * R[:, 1] - distance[:, None] * R[:, 0]
    # The field is linear in the moment, so its derivative gives the field of any moment.
    _, field_of_moment = dipole_jacobians(network.positions - points[:, :, None], np.zeros(3))
    A = (whitening @ field_of_moment).reshape(*points.shape[:2], -1, 3)
    is_reached = np.einsum('lpmk,mk->lpm', moments @ (np.swapaxes(A, 2, 3) @ A), moments) >= energy
    first = np.where(is_reached.any(axis=1), is_reached.argmax(axis=1), len(distance) - 1)
    return np.take_along_axis(points, first[:, :, None], axis=1)


def _initial_states(settings: VehicleSettings, kind: int, positions: FloatArray,
                    velocities: FloatArray, hard_iron: FloatArray) -> FloatArray:
    """Initial states (n_offsets * n_speeds * n_moments, n_t) for `positions` (n_offsets, n_moments,
    3), `velocities` (n_speeds, 3), and total moments `hard_iron` (n_moments, 3)."""
    d = _n_dipoles(settings)
    n_turn = int(settings.turn_acceleration > 0.0)
    x = np.empty((len(positions), len(velocities), len(hard_iron), 8 + 3 * d + min(d, 2) + n_turn))
    x[..., :3], x[..., 3:6] = positions[:, None], velocities[:, None]
    x[..., 6:6 + 3 * d] = np.tile(hard_iron / d, d)
    x[..., 6 + 3 * d:] = [*[soft_iron(settings, kind)] * 3,
                          *[settings.kinds[kind].length] * (d > 1), *[0.0] * n_turn]
    return x.reshape(-1, x.shape[-1])


def starting_covariance(settings: VehicleSettings, kind: int, R: FloatArray, speed: float
                        ) -> FloatArray:
    """Initial covariance (n_t, n_t) of an arrival along the x axis of `R` (3, 3)."""
    d, of_kind = _n_dipoles(settings), settings.kinds[kind]
    soft_index = 6 + 3 * d
    soft_iron_std = settings.induced_share_std * _soft_iron_per_share(settings, kind)
    n_t = soft_index + 2 + min(d, 2) + int(settings.turn_acceleration > 0.0)
    P = np.zeros((n_t, n_t))
    P[:3, :3] = R @ np.diag([ALONG_STD**2, LATERAL_STD**2, of_kind.height_std**2]) @ R.T
    P[3:6, 3:6] = R @ np.diag([(SPEED_STD * speed) ** 2, (CROSS_SPEED_STD * speed) ** 2,
                               CLIMB_STD**2]) @ R.T
    mean = np.full((d, d), 1.0 / d)
    among_dipoles = of_kind.moment_std**2 / d * mean \
        + of_kind.difference_std**2 * (np.eye(d) - mean)
    P[6:soft_index, 6:soft_index] = np.kron(among_dipoles, np.eye(3))
    P[soft_index:soft_index + 3, soft_index:soft_index + 3] = soft_iron_std**2 * (1.0 + np.eye(3))
    if d > 1:
        P[soft_index + 3, soft_index + 3] = of_kind.length_std**2
    return P
