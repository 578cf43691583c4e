"""Networks whose sensors or network files are wrong, and healthy networks that resemble them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.geometry import rotation_about_z
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from support import spoiler
from support.random_passes import SIMULATORS
from support.situation_worlds import ROAD, car, straight
from support.situations import wrong_of


@dataclass(frozen=True)
class Configuration:
    """Entry of `CONFIGURATIONS`."""

    faults: tuple = ()
    """Functions of `support.spoiler` that change the readings."""
    described: Callable = lambda network: network
    """Change of the network file."""
    is_healthy: bool = False


def moved(sensor, offset):
    """Network file in which a sensor (all if None) is displaced by `offset` [m]."""
    def change(network):
        rows = slice(None) if sensor is None else network.index(sensor)
        positions = network.positions.copy()
        positions[rows] += offset
        return replace(network, positions=positions)
    return change


def without_earth_field(network):
    return replace(network, earth_field=None)


def turned(degrees):
    """Fault: `mag_2` is rotated about the vertical."""
    return spoiler.transformed('mag_2', rotation_about_z(np.deg2rad(degrees)).T)


def swapped(first, second):
    """Fault: two axes of `mag_2` are exchanged."""
    order = ['xyz'.index(a) for a in 'xyz']
    order['xyz'.index(first)], order['xyz'.index(second)] = 'xyz'.index(second), \
        'xyz'.index(first)
    return spoiler.transformed('mag_2', np.eye(3)[order])


UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])

CONFIGURATIONS = {
    'gain 0.53': Configuration((spoiler.transformed('mag_2', 0.53),)),
    'gain 0.7': Configuration((spoiler.transformed('mag_2', 0.7),)),
    'gain 1.9': Configuration((spoiler.transformed('mag_2', 1.9),)),
    'gain 0.53, both': Configuration((spoiler.transformed(None, 0.53),)),
    'gain 0.5 of z': Configuration((spoiler.transformed('mag_2', np.diag([1.0, 1.0, 0.5])),)),
    'inverted': Configuration((spoiler.transformed('mag_2', -1.0),)),
    'inverted, both': Configuration((spoiler.transformed(None, -1.0),)),
    'sensors exchanged': Configuration((spoiler.exchanged('mag_1', 'mag_2'),)),
    'x and y exchanged': Configuration((swapped('x', 'y'),)),
    'y and z exchanged': Configuration((swapped('y', 'z'),)),
    'y flipped': Configuration((spoiler.wrong_sign('mag_2', 'y'),)),
    'x flipped': Configuration((spoiler.wrong_sign('mag_2', 'x'),)),
    'upside down': Configuration((spoiler.transformed('mag_2', UPSIDE_DOWN),)),
    'upside down, both': Configuration((spoiler.transformed(None, UPSIDE_DOWN),)),
    'moved 1.5 m along': Configuration(described=moved('mag_2', [1.5, 0.0, 0.0])),
    'moved 1.5 m across': Configuration(described=moved('mag_2', [0.0, 1.5, 0.0])),
    'yaw 20 deg': Configuration((turned(20.0),)),
    'yaw 90 deg': Configuration((turned(90.0),)),
    'yaw 90 deg, no earth_field': Configuration((turned(90.0),), without_earth_field),
    '0.8 m too high': Configuration(described=moved(None, [0.0, 0.0, 0.8])),
    '0.8 m too high, one': Configuration(described=moved('mag_2', [0.0, 0.0, 0.8])),
    'correct': Configuration(is_healthy=True),
    'no earth_field': Configuration(described=without_earth_field, is_healthy=True),
    'offsets of 4 uT': Configuration((spoiler.offset('mag_1', [4e-6, -3e-6, 3e-6]),
                                      spoiler.offset('mag_2', [-2e-6, 3e-6, -4e-6])),
                                     is_healthy=True),
    'an offset of 10 uT': Configuration((spoiler.offset('mag_2', [2e-6, 3e-6, 9e-6]),),
                                        is_healthy=True),
    'yaw 3 deg': Configuration((turned(3.0),), is_healthy=True),
}
"""{name: configuration} of two sensors beside a road."""


@dataclass(frozen=True)
class Poses:
    """Poses of the runs of a configuration."""

    n: int = 0
    unflagged: int = 0
    wrong: int = 0
    """Unflagged and wrong."""
    right: int = 0
    """Right, whether flagged or not."""
    smoothed: int = 0
    """Unflagged smoothed poses."""
    smoothed_wrong: int = 0

    def __add__(self, other):
        return Poses(*(a + b for a, b in zip(vars(self).values(), vars(other).values(),
                                             strict=True)))


def configuration_world(name, simulator, seed):
    """Simulate a car that passes the sensors of a configuration; return a `World`."""
    configuration = CONFIGURATIONS[name]
    # Equal passes in all configurations.
    rng = np.random.default_rng([seed, SIMULATORS.index(simulator)])
    clean = straight(rng, simulator, car(rng, simulator), rng.uniform(7.0, 20.0))
    return replace(clean, readings=spoiler.apply(clean.readings, *configuration.faults),
                   network=configuration.described(ROAD))


def tracked_poses(name, simulator, seed):
    """Track a car with the sensors of a configuration; return `Poses`."""
    a_world = configuration_world(name, simulator, seed)
    pipeline = Pipeline(a_world.network, settings_for('vehicle'))
    records = pipeline.feed(a_world.readings) + pipeline.flush()
    tracks = [r for r in records if isinstance(r, Track) and not r.ended]
    smoothed = [r for r in records if isinstance(r, SmoothedPose) and not r.ambiguous]
    ambiguous = np.array([r.ambiguous for r in tracks], dtype=bool)
    wrong = wrong_of(tracks, a_world)
    return Poses(len(tracks), int((~ambiguous).sum()), int((wrong & ~ambiguous).sum()),
                 int((~wrong).sum()), len(smoothed), int(wrong_of(smoothed, a_world).sum()))
