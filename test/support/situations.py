"""Situations: worlds that the tracker's model does not assume, and how often it is sure and wrong.

Each is made by one function of a random generator and a simulator's name ('clouds' or 'boxes'),
which gives a `World`. Sizes, speeds and lanes are drawn anew for each seed.
"""

from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.event_records import Disturbance
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.simulation.scenario import Path, random_vehicle
from support import spoiler
from support.box_vehicles import box_car, box_truck
from support.bundled import NETWORK_FILE
from support.passes import network_of
from support.random_passes import SIMULATORS, are_wrong, errors_of, random_pass
from support.worlds import FLAWS, Convoy, Ride, box_two_wheeler, world

ROAD = read_network(NETWORK_FILE)
FOUR = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0], [9.0, -4.5, 0.0], [9.0, 4.5, 0.0]])
QUIET_S = 7.0
"""[s] without a vehicle near, in which a background is learnt."""


# Bodies.

def car(rng, simulator):
    if simulator == 'boxes':
        return box_car(rng)
    return random_vehicle(rng, rng.uniform(3.6, 4.8), moment=rng.uniform(300.0, 600.0))


def truck(rng, simulator, length=None, moment=None):
    length = rng.uniform(7.0, 16.0) if length is None else length
    moment = rng.uniform(1200.0, 2200.0) if moment is None else moment
    if simulator == 'boxes':
        return box_truck(rng, length, moment)
    return random_vehicle(rng, length, 2.4, 2.8, moment=moment)


def small(rng, simulator, length, moment, iron=1.0):
    """A motorcycle, a bicycle or a trolley."""
    if simulator == 'boxes':
        return box_two_wheeler(rng, length, moment, iron)
    return random_vehicle(rng, length, 0.5, 1.0, n_parts=20, moment=moment)


def car_with_trailer(rng, simulator):
    trailer = truck(rng, simulator, rng.uniform(4.0, 6.0), rng.uniform(100.0, 300.0)) \
        if simulator == 'clouds' else box_car(rng, rng.uniform(4.0, 6.0), rng.uniform(100.0, 300.0))
    return Convoy((car(rng, simulator), trailer), (-2.9, 2.9))


def wagon(rng, simulator):
    return truck(rng, simulator, 18.0, rng.uniform(2500.0, 5000.0))


# Courses.

def lane(rng, speed, away=None, y=None):
    """A straight `Path` along the road; the vehicle is at the sensors after away / speed [s]."""
    away = QUIET_S * speed + 25.0 if away is None else away
    y = rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.6) if y is None else y
    forward = rng.random() < 0.5
    return Path(np.array([-away if forward else away, y]), 0.0 if forward else np.pi, speed), away


def straight(rng, simulator, body, speed, network=ROAD, **of_lane):
    """A body straight past the sensors."""
    path, away = lane(rng, speed, **of_lane)
    return world(network, [(body, path)], 2.0 * away / speed + 4.0, rng, FLAWS[simulator])


def stop_and(rng, stop_s, then):
    """(`Ride`, duration [s]): a vehicle stops near the sensors, and then goes on at `then` times
    its speed (0: never)."""
    speed = rng.uniform(6.0, 12.0)
    brake = rng.uniform(1.5, 3.0)
    path, away = lane(rng, speed, y=rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.6))
    at = away + rng.uniform(-5.0, 3.0)
    braked = speed / brake
    begin = (at - 0.5 * speed * braked) / speed
    times = [0.0, begin, begin + braked, begin + braked + stop_s]
    times += [times[-1] + max(abs(then), 0.1) * speed / 2.0]
    duration = times[-1] + (50.0 / speed if then else 0.0)
    return Ride(path, tuple(times), (speed, speed, 0.0, 0.0, then * speed)), duration


def stopping(rng, simulator, stop_s, then=1.0):
    ride, duration = stop_and(rng, stop_s, then)
    return world(ROAD, [(car(rng, simulator), ride)], duration, rng, FLAWS[simulator])


def u_turn(rng, simulator):
    radius = rng.uniform(4.0, 5.5)
    speed = np.sqrt(radius * rng.uniform(1.5, 3.5))
    before = QUIET_S * speed + 20.0
    path = Path(np.array([-before - rng.uniform(-2.0, 4.0), -0.9 * radius]), 0.0, speed, before,
                np.pi, radius)
    return world(ROAD, [(car(rng, simulator), path)], (2.0 * before + 15.0) / speed, rng,
                 FLAWS[simulator])


def leaves(rng, simulator, cars=0):
    """A car stands near the sensors from the beginning and leaves; then others may pass."""
    at, y = rng.uniform(-4.0, 4.0), rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 2.0)
    stands = rng.uniform(10.0, 20.0)
    top = rng.uniform(6.0, 12.0)
    forward = rng.random() < 0.5
    path = Path(np.array([at, y]), 0.0 if forward else np.pi, top)
    ride = Ride(path, (0.0, stands, stands + top / 2.0), (0.0, 0.0, top))
    duration = stands + top / 2.0 + 60.0 / top + 6.0
    movers = [(car(rng, simulator), ride)]
    for _ in range(cars):
        speed = rng.uniform(7.0, 15.0)
        other, _ = lane(rng, speed, away=speed * duration)
        movers.append((car(rng, simulator), other))
        duration += 12.0
    return world(ROAD, movers, duration, rng, FLAWS[simulator])


def parked(rng, simulator):
    """A car stands 5 to 8 m beside the sensors for good; another one passes."""
    place = np.array([rng.uniform(-4.0, 4.0), rng.choice([-1.0, 1.0]) * rng.uniform(7.0, 9.0)])
    stands = Ride(Path(place, 0.0, 1.0), (0.0, 1.0), (0.0, 0.0))
    speed = rng.uniform(7.0, 15.0)
    path, away = lane(rng, speed)
    return world(ROAD, [(car(rng, simulator), stands), (car(rng, simulator), path)],
                 2.0 * away / speed, rng, FLAWS[simulator])


def two(rng, simulator, how, network=ROAD):
    """Two cars that 'meet', 'overtake' or 'follow' each other at the sensors."""
    speed = rng.uniform(7.0, 14.0)
    y = rng.uniform(1.0, 1.6)
    away = QUIET_S * speed + 30.0
    first = Path(np.array([-away, -y]), 0.0, speed)
    if how == 'meet':
        other = speed * rng.uniform(0.8, 1.2)
        second = Path(np.array([away / speed * other + rng.uniform(-5.0, 5.0), y]), np.pi, other)
    elif how == 'overtake':
        other = speed * rng.uniform(1.3, 1.7)
        second = Path(np.array([-away / speed * other + rng.uniform(-5.0, 5.0), y]), 0.0, other)
    else:
        second = Path(np.array([-away - speed * rng.uniform(1.0, 2.0), -y]), 0.0, speed)
    movers = [(car(rng, simulator), first), (car(rng, simulator), second)]
    return world(network, movers, 2.0 * away / speed + 4.0, rng, FLAWS[simulator])


def spoilt_car(rng, simulator, *faults):
    """A car past sensors with faults of `support.spoiler`."""
    made = straight(rng, simulator, car(rng, simulator), rng.uniform(7.0, 20.0))
    return replace(made, readings=spoiler.apply(made.readings, *faults))


def usual(rng, simulator, kind):
    """A pass of `support.random_passes`."""
    seed = int(rng.integers(1 << 30))
    body, course, duration, flaws = random_pass(simulator, kind, seed)
    return world(ROAD, [(body, course)], duration, rng, flaws)


# Without any target, or with one in a disturbance.

def ambient_world(rng, simulator, ambient, duration, rate=100.0, cars=0):
    """A field over the whole network, and perhaps cars."""
    movers = []
    for k in range(cars):
        speed = rng.uniform(7.0, 15.0)
        path, _ = lane(rng, speed, away=speed * (duration / cars * (k + 0.6)))
        movers.append((car(rng, simulator), path))
    return world(ROAD, movers, duration, rng, FLAWS[simulator], rate, ambient)


def uniform(vector, of_time):
    """A field (3,) [T] that is the same at all sensors, times a function of time."""
    return lambda t: np.broadcast_to(of_time(t)[:, None, None] * vector, (len(t), len(ROAD), 3))


def direction(rng):
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def hum(rng, simulator, frequency, rate):
    """A power line to one side: its field is larger at the nearer sensor."""
    near = rng.uniform(0.5, 1.0, 2)
    v = rng.uniform(1e-7, 3e-7) * direction(rng)
    turns = 2.0 * np.pi * frequency * rng.uniform(0.9995, 1.0005)
    return ambient_world(rng, simulator, lambda t: np.sin(turns * t)[:, None, None]
                         * near[:, None] * v, 60.0, rate)


def tram(rng, simulator):
    """The current of a line 30 to 60 m away is switched on and off: 100 to 500 A, with ramps."""
    times = np.sort(rng.uniform(12.0, 55.0, 4))
    away, current = rng.uniform(30.0, 60.0), rng.uniform(100.0, 500.0)
    y = ROAD.positions[:, 1]
    # Of an infinite wire along x, 5 m above the ground.
    r2 = (away - y)**2 + 25.0
    B = 2e-7 * current * np.stack([0.0 * y, 5.0 / r2, (away - y) / r2], axis=1)
    ramp = rng.uniform(0.2, 2.0)
    return ambient_world(rng, simulator, lambda t: np.interp(
        t, np.concatenate([[s, s + ramp] for s in times]), [0, 1, 1, 0, 0, 1, 1, 0]
    )[:, None, None] * B, 65.0)


def storm(rng, simulator, cars=0):
    """500 nT in ten minutes, as a sum of slow waves; here the steepest minutes of it."""
    v = 5e-7 * direction(rng)
    periods, phases = rng.uniform(60.0, 400.0, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    return ambient_world(rng, simulator, uniform(v, lambda t: sum(
        np.sin(2.0 * np.pi * t / p + f) for p, f in zip(periods, phases, strict=True)) / 3.0
        + t / 600.0), 120.0, cars=cars)


def pulsations(rng, simulator):
    """20 nT with a period of 20 to 60 s."""
    p = rng.uniform(20.0, 60.0)
    return ambient_world(rng, simulator, uniform(
        2e-8 * direction(rng), lambda t: np.sin(2.0 * np.pi * t / p)), 120.0)


def knocked(rng, simulator):
    """A sensor is turned by some degrees within a tenth of a second."""
    made = ambient_world(rng, simulator, None, 40.0)
    angles = np.deg2rad(rng.uniform(1.0, 5.0)) * direction(rng)
    n = int(15.0 * 100.0) * 2
    field = made.readings.field.copy()
    mine = np.flatnonzero(made.readings.sensor == 0)
    mine = mine[mine >= n]
    field[mine] += np.cross(field[mine], angles)
    return replace(made, readings=replace(made.readings, field=field))


def ramps(rng, simulator):
    """Each sensor warms up on its own: up to 5 nT/s for 10 to 30 s, then back."""
    rates = rng.uniform(1e-9, 5e-9, (2, 1)) * np.array([direction(rng), direction(rng)])
    lasts = rng.uniform(10.0, 30.0)
    return ambient_world(rng, simulator, lambda t: np.interp(
        t, [12.0, 12.0 + lasts, 12.0 + 2 * lasts], [0.0, lasts, 0.0])[:, None, None] * rates, 90.0)


def far(rng, simulator, body):
    """Something large passes far away: hardly a field is felt."""
    return straight(rng, simulator, body, rng.uniform(15.0, 25.0), away=200.0,
                    y=rng.choice([-1.0, 1.0]) * rng.uniform(30.0, 60.0))


def train(rng, simulator, y):
    """Five wagons of 18 m; a pose at any of them is right."""
    speed = rng.uniform(10.0, 20.0)
    path, away = lane(rng, speed, away=250.0, y=rng.choice([-1.0, 1.0]) * y)
    along = np.array([np.cos(path.heading), np.sin(path.heading)])
    movers = [(wagon(rng, simulator), replace(path, start=path.start + 20.0 * k * along))
              for k in range(-2, 3)]
    return world(ROAD, movers, 2.0 * away / speed, rng, FLAWS[simulator])


@dataclass(frozen=True)
class Situation:
    """A row of the table."""

    make: object
    """Takes a generator and a simulator's name, gives a `World`."""
    aim: float = 0.02
    """At most this share of the unflagged poses may be wrong."""
    group: str = 'one'
    """'control' (tracked well), 'one' vehicle or none, 'several' vehicles, 'nothing' at all."""


SITUATIONS = {
    'a car': Situation(lambda r, s: usual(r, s, 'car'), group='control'),
    'a truck': Situation(lambda r, s: usual(r, s, 'truck'), group='control'),
    'a car that turns': Situation(lambda r, s: usual(r, s, 'turning'), group='control'),
    'a car of 25 to 40 m/s': Situation(
        lambda r, s: straight(r, s, car(r, s), r.uniform(25.0, 40.0)), group='control'),
    'a U-turn': Situation(u_turn, group='control'),
    'a car, four sensors': Situation(
        lambda r, s: straight(r, s, car(r, s), r.uniform(7.0, 20.0), FOUR), group='control'),
    'a car of 60 m/s': Situation(lambda r, s: straight(r, s, car(r, s), 60.0)),
    'clocks 50 ms apart': Situation(lambda r, s: spoilt_car(r, s, spoiler.delayed('mag_2', 0.05))),
    'clocks 100 ms apart': Situation(lambda r, s: spoilt_car(r, s, spoiler.delayed('mag_2', 0.1))),
    'clocks 200 ms apart': Situation(lambda r, s: spoilt_car(r, s, spoiler.delayed('mag_2', 0.2))),
    'over a sensor': Situation(lambda r, s: straight(
        r, s, car(r, s), r.uniform(7.0, 20.0), y=r.choice([-4.5, 4.5]) + r.uniform(-0.4, 0.4))),
    'stops for 5 s': Situation(lambda r, s: stopping(r, s, 5.0)),
    'stops for 20 s': Situation(lambda r, s: stopping(r, s, 20.0)),
    'stops for 60 s': Situation(lambda r, s: stopping(r, s, 60.0)),
    'parks': Situation(lambda r, s: stopping(r, s, 60.0, 0.0)),
    'reverses': Situation(lambda r, s: stopping(r, s, 2.0, -0.5)),
    'crawls at 0.3 m/s': Situation(lambda r, s: straight(r, s, car(r, s), 0.3, away=15.0)),
    'a trolley at 1.3 m/s': Situation(lambda r, s: straight(
        r, s, small(r, s, 1.0, r.uniform(8.0, 15.0), 0.1), 1.3, away=20.0,
        y=r.choice([-1.0, 1.0]) * r.uniform(2.0, 3.5))),
    'a bicycle': Situation(lambda r, s: straight(
        r, s, small(r, s, 1.7, r.uniform(4.0, 8.0), 0.1), r.uniform(4.0, 7.0),
        y=r.choice([-1.0, 1.0]) * r.uniform(2.0, 3.5))),
    'a motorcycle': Situation(lambda r, s: straight(
        r, s, small(r, s, 2.1, r.uniform(40.0, 60.0)), r.uniform(8.0, 18.0))),
    'a car with a trailer': Situation(lambda r, s: straight(
        r, s, car_with_trailer(r, s), r.uniform(7.0, 15.0))),
    # From the nearer sensor.
    'a train at 9 m': Situation(lambda r, s: train(r, s, 13.5)),
    'there at the start, leaves': Situation(leaves),
    'there at the start, then cars': Situation(lambda r, s: leaves(r, s, cars=2)),
    'parked beside a passing car': Situation(parked),
    'one sensor alone': Situation(lambda r, s: spoilt_car(r, s, spoiler.only_sensor('mag_1'))),
    'one axis flipped': Situation(lambda r, s: spoilt_car(r, s, spoiler.wrong_sign('mag_2', 'y'))),
    'clipped at half its peak': Situation(lambda r, s: spoilt_car(r, s, spoiler.clipped(0.5))),
    'warming by 10 nT/s': Situation(lambda r, s: spoilt_car(r, s, spoiler.drift(1e-8))),
    'a temperature step': Situation(lambda r, s: spoilt_car(
        r, s, spoiler.temperature_step(3e-7, 4.0))),
    'two that meet': Situation(lambda r, s: two(r, s, 'meet'), aim=0.05, group='several'),
    'one overtakes': Situation(lambda r, s: two(r, s, 'overtake'), aim=0.05, group='several'),
    'one follows': Situation(lambda r, s: two(r, s, 'follow'), aim=0.05, group='several'),
    'two that meet, four sensors': Situation(lambda r, s: two(r, s, 'meet', FOUR), aim=0.05,
                                        group='several'),
    'one follows, four sensors': Situation(lambda r, s: two(r, s, 'follow', FOUR), aim=0.05,
                                      group='several'),
    'hum of 50 Hz at 50 Hz': Situation(lambda r, s: hum(r, s, 50.0, 50.0), group='nothing'),
    'hum of 16.7 Hz at 100 Hz': Situation(lambda r, s: hum(r, s, 16.7, 100.0), group='nothing'),
    'a tram line switched': Situation(tram, group='nothing'),
    'a storm': Situation(storm, group='nothing'),
    'pulsations of 20 nT': Situation(pulsations, group='nothing'),
    'cars in a storm': Situation(lambda r, s: storm(r, s, cars=4)),
    'a sensor knocked': Situation(knocked, group='nothing'),
    'slow ramps': Situation(ramps, group='nothing'),
    'a truck far away': Situation(lambda r, s: far(r, s, truck(r, s))),
    'a train far away': Situation(lambda r, s: train(r, s, r.uniform(40.0, 60.0))),
}
"""{situation: `Situation`}."""


def made(name, simulator, seed):
    """The `World` of a situation."""
    rng = np.random.default_rng([seed, sorted(SITUATIONS).index(name),
                                 SIMULATORS.index(simulator)])
    return SITUATIONS[name].make(rng, simulator)


@dataclass(frozen=True)
class Verdict:
    """What was said of one `World`; the arrays are over its published poses."""

    stamps: np.ndarray
    """(n,) [s]"""
    ids: np.ndarray
    ambiguous: np.ndarray
    wrong: np.ndarray
    """(n,) off by more than 2 m and 3 deviations from every body."""
    smoothed_sure: int
    smoothed_wrong: int
    n_tracks: int
    n_disturbances: int
    n_mistaken: int
    """Disturbances that a body is taken for: their tracks follow it."""
    doubts: tuple
    """(n,) of each pose."""

    @property
    def n_sure(self):
        return int((~self.ambiguous).sum())

    @property
    def n_wrong(self):
        return int((~self.ambiguous & self.wrong).sum())


def wrong_of(poses, a_world):
    """(n,) whether `Track`s or `SmoothedPose`s are wrong of every body of a `World`."""
    wrong = np.ones(len(poses), dtype=bool)
    for position in a_world.positions:
        size, along, *_ = errors_of(poses, a_world.t, position)
        wrong &= are_wrong(size, along)
    return wrong


def mistaken(disturbances, tracks, a_world):
    """Those of [`Disturbance`] whose tracks follow a body of a `World`, within 5 m."""
    out = []
    for d in disturbances:
        poses = [r for r in tracks if r.id == d.track_id]
        error = [errors_of(poses, a_world.t, position)[0] for position in a_world.positions]
        if error and np.median(np.min(error, axis=0)) < 5.0:
            out.append(d)
    return out


def verdict(name, simulator, seed, changes=None):
    """`Verdict` on a situation, with {setting: value} as `changes`."""
    a_world = made(name, simulator, seed)
    pipeline = Pipeline(a_world.network, settings_for('vehicle', changes))
    records = pipeline.feed(a_world.readings) + pipeline.flush()
    tracks = [r for r in records if isinstance(r, Track) and not r.ended]
    smoothed = [r for r in records if isinstance(r, SmoothedPose) and not r.ambiguous]
    disturbances = [r for r in records if isinstance(r, Disturbance) and r.ended]
    return Verdict(
        np.array([r.stamp_ns for r in tracks]) / 1e9, np.array([r.id for r in tracks]),
        np.array([r.ambiguous for r in tracks], dtype=bool), wrong_of(tracks, a_world),
        len(smoothed), int(wrong_of(smoothed, a_world).sum()), pipeline.track.counts['tracks'],
        len(disturbances), len(mistaken(disturbances, tracks, a_world)),
        tuple(r.doubts for r in tracks))
