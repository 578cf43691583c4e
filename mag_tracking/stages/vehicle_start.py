"""Where a vehicle's track begins: its settings, its model and the first hypotheses."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.inference.detection_theory import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.physics.dipole import MU0, dipole_field
from mag_tracking.physics.sources import PointVehicle
from mag_tracking.settings import param


@dataclass(frozen=True)
class VehicleSettings:
    """The point vehicle: its motion, its magnetism and where it may come from."""

    arrival_names: tuple[str, ...] = param(
        ('left', 'right', 'rear'), 'Names of the arrival directions.')
    arrival_headings_deg: tuple[float, ...] = param(
        (0.0, 180.0, 90.0), 'Heading on arrival, one per name; 0 = along x, anticlockwise. '
        'The lines go through the centre of the network.', 'deg', (-360.0, 360.0))
    lateral_offsets: tuple[float, ...] = param(
        (-4.0, 0.0, 4.0), 'Starting lines left (+) and right (-) of the arrival line.',
        'm', (-1000.0, 1000.0))
    lateral_std: float = param(1.5, 'Spread about a starting line.', 'm', (1e-3, 1000.0))
    along_std: float = param(3.0, 'Spread of the starting distance.', 'm', (1e-3, 1000.0))
    farthest: float = param(
        30.0, 'Largest starting distance from the outermost sensor.', 'm', (0.1, 10000.0))
    height: float = param(0.5, 'Height of the magnetic centre above the sensors\' plane z = 0.',
                          'm', (-100.0, 100.0))
    height_std: float = param(0.2, 'Spread of the height.', 'm', (1e-6, 100.0))
    speeds: tuple[float, ...] = param((5.0, 10.0, 20.0), 'Starting speeds.', 'm/s', (0.01, 200.0))
    speed_std: float = param(0.3, 'Spread of a starting speed, relative to it.', '', (1e-3, 10.0))
    cross_speed_std: float = param(
        0.1, 'Spread of the speed across the heading, relative to it.', '', (1e-3, 10.0))
    climb_std: float = param(0.1, 'Spread of the vertical speed.', 'm/s', (1e-9, 100.0))
    moment: float = param(400.0, 'Starting size of the moment (a car: 300 to 600; TSP14).',
                          'A m^2', (1e-6, 1e6))
    moment_std: float = param(150.0, 'Spread of the hard iron moment, per axis.',
                              'A m^2', (1e-6, 1e6))
    soft_iron: float = param(4.0, 'Starting soft iron scalar D; m = Rz m0 + D/mu0 B0.',
                             'm^3', (0.0, 1e4))
    soft_iron_std: float = param(4.0, 'Spread of D; without an earth field it has no effect.',
                                 'm^3', (0.0, 1e4))
    acceleration: float = param(
        1.0, 'Root spectral density of the horizontal acceleration.', 'm/s^1.5', (0.0, 1000.0))
    climb_acceleration: float = param(
        0.1, 'Root spectral density of the vertical acceleration.', 'm/s^1.5', (0.0, 1000.0))
    moment_drift: float = param(
        40.0, 'Random walk of the hard iron moment: a long target shows another one from every '
        'side.', 'A m^2/s^0.5', (0.0, 1e6))


def vehicle_model(settings, network):
    """The `PointVehicle` of the settings; without an earth field there is no soft iron."""
    earth = np.zeros(3) if network.earth_field is None else network.earth_field
    horizontal, vertical = settings.acceleration**2, settings.climb_acceleration**2
    return PointVehicle(earth, np.array([horizontal, horizontal, vertical]),
                        settings.moment_drift**2)


def moment_directions():
    """Fourteen unit vectors (14, 3): the axes and the diagonals of a cube, both ways."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    diagonals = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)])
    return np.vstack([axes, diagonals / np.sqrt(3.0)])


def start_vehicle(settings, network, frame, background_std, mounting_std):
    """Hypotheses of a vehicle at its first frame.

    Arrival lines x moment directions x lateral offsets x speeds, each at the
    distance at which its field, coming nearer, first has the measured energy.

    Returns a `FilterBank` whose labels index `settings.arrival_names`.
    Source: ICASSP11 section 2.2, T10 Alg. 3 (there one hypothesis an arrival).
    """
    earth = np.zeros(3) if network.earth_field is None else network.earth_field
    moments = settings.moment * moment_directions()
    states, covariances, labels = [], [], []
    for label, heading in enumerate(np.deg2rad(settings.arrival_headings_deg)):
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        for offset in settings.lateral_offsets:
            starts = _matching_positions(settings, network, frame, R, offset, moments)
            hard = (moments - settings.soft_iron * earth / MU0) @ R
            for speed in settings.speeds:
                x = np.zeros((len(moments), 10))
                x[:, :3], x[:, 3:6], x[:, 6:9] = starts, R @ [speed, 0.0, 0.0], hard
                x[:, 9] = settings.soft_iron
                states.append(x)
                covariances += [_vehicle_covariance(settings, R, speed)] * len(moments)
                labels += [label] * len(moments)
    return FilterBank.of_targets(np.vstack(states), np.array(covariances), np.array(labels),
                                  len(network), background_std, mounting_std)


def _matching_positions(settings, network, frame, R, offset, moments):
    """Positions (n, 3) on one line where each moment's field first has the frame's energy."""
    along = (network.positions - network.centre) @ R[:, 0]
    distance = np.linspace(settings.farthest, 0.0, 160) - along.min()
    line = np.array([network.centre[0], network.centre[1], settings.height])
    points = line + offset * R[:, 1] - distance[:, None] * R[:, 0]
    r = network.positions[None] - points[:, None]
    B = dipole_field(r[None], moments[:, None, None, :])
    y = np.einsum('jik,mdjk->mdji', network.R_sw, B)
    present = ~np.isnan(frame.field)
    measured = float(whitened_energy(frame.field, frame.covariance)[0].sum())
    std = np.sqrt(np.einsum('jii->ji', frame.covariance))
    energy = np.where(present, (y / np.where(present, std, 1.0)) ** 2, 0.0).sum(axis=(2, 3))
    # Noise alone brings one unit of energy an axis.
    reached = energy >= max(measured - np.count_nonzero(present), 1.0)
    first = np.where(reached.any(axis=1), reached.argmax(axis=1), len(distance) - 1)
    return points[first]


def _vehicle_covariance(settings, R, speed):
    """Starting covariance (10, 10) of one hypothesis."""
    P = np.zeros((10, 10))
    P[:3, :3] = R @ np.diag([settings.along_std**2, settings.lateral_std**2,
                             settings.height_std**2]) @ R.T
    P[3:6, 3:6] = R @ np.diag([(settings.speed_std * speed) ** 2,
                               (settings.cross_speed_std * speed) ** 2,
                               settings.climb_std**2]) @ R.T
    P[6:9, 6:9] = settings.moment_std**2 * np.eye(3)
    P[9, 9] = settings.soft_iron_std**2
    return P
