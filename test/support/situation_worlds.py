"""Worlds for `support.situations`: bodies, courses and disturbances.

Most functions take a random generator and the name of a simulator ('clouds' or 'boxes'), and return
a body or a `World` with random sizes, speeds and lanes.
"""

from dataclasses import replace

import numpy as np

from mag_tracking.network.file import read_network
from mag_tracking.simulation.scenario import Path, random_vehicle
from support import spoiler
from support.box_vehicles import box_car, box_truck
from support.bundled import NETWORK_FILE
from support.passes import network_of
from support.random_passes import random_pass
from support.worlds import FLAWS, Convoy, Ride, box_two_wheeler, world

ROAD = read_network(NETWORK_FILE)
FOUR = network_of([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0], [9.0, -4.5, 0.0], [9.0, 4.5, 0.0]])
QUIET_S = 7.0
"""[s] Interval without a vehicle nearby, for learning the background."""


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
    """Body of a random motorcycle, bicycle or trolley."""
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

def lane(rng, speed, start_m=None, y=None):
    """Straight `Path` along the road, and the distance [m] of its start from the sensors."""
    start_m = QUIET_S * speed + 25.0 if start_m is None else start_m
    y = rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.6) if y is None else y
    forward = rng.random() < 0.5
    return Path(np.array([-start_m if forward else start_m, y]), 0.0 if forward else np.pi,
                speed), start_m


def straight(rng, simulator, body, speed, network=ROAD, **of_lane):
    """World with a body on a straight path past the sensors."""
    path, start_m = lane(rng, speed, **of_lane)
    return world(network, [(body, path)], 2.0 * start_m / speed + 4.0, rng, FLAWS[simulator])


def stopping_ride(rng, stop_s, then):
    """Random `Ride` that stops near the sensors, then continues at `then` times its speed.

    Returns (ride, duration [s]).
    """
    speed = rng.uniform(6.0, 12.0)
    deceleration = rng.uniform(1.5, 3.0)
    path, start_m = lane(rng, speed, y=rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.6))
    stop_m = start_m + rng.uniform(-5.0, 3.0)
    braking_s = speed / deceleration
    begin = (stop_m - 0.5 * speed * braking_s) / speed
    times = [0.0, begin, begin + braking_s, begin + braking_s + stop_s]
    times += [times[-1] + max(abs(then), 0.1) * speed / 2.0]
    duration = times[-1] + (50.0 / speed if then else 0.0)
    return Ride(path, tuple(times), (speed, speed, 0.0, 0.0, then * speed)), duration


def stopping_car(rng, simulator, stop_s, then=1.0):
    ride, duration = stopping_ride(rng, stop_s, then)
    return world(ROAD, [(car(rng, simulator), ride)], duration, rng, FLAWS[simulator])


def u_turn(rng, simulator):
    radius = rng.uniform(4.0, 5.5)
    speed = np.sqrt(radius * rng.uniform(1.5, 3.5))
    before = QUIET_S * speed + 20.0
    path = Path(np.array([-before - rng.uniform(-2.0, 4.0), -0.9 * radius]), 0.0, speed, before,
                np.pi, radius)
    return world(ROAD, [(car(rng, simulator), path)], (2.0 * before + 15.0) / speed, rng,
                 FLAWS[simulator])


def departing_car(rng, simulator, cars=0):
    """World with a car that is parked at the start and leaves; then `cars` other cars pass."""
    x, y = rng.uniform(-4.0, 4.0), rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 2.0)
    parked_s = rng.uniform(10.0, 20.0)
    final_speed = rng.uniform(6.0, 12.0)
    forward = rng.random() < 0.5
    path = Path(np.array([x, y]), 0.0 if forward else np.pi, final_speed)
    ride = Ride(path, (0.0, parked_s, parked_s + final_speed / 2.0), (0.0, 0.0, final_speed))
    duration = parked_s + final_speed / 2.0 + 60.0 / final_speed + 6.0
    movers = [(car(rng, simulator), ride)]
    for _ in range(cars):
        speed = rng.uniform(7.0, 15.0)
        other, _ = lane(rng, speed, start_m=speed * duration)
        movers.append((car(rng, simulator), other))
        duration += 12.0
    return world(ROAD, movers, duration, rng, FLAWS[simulator])


def parked_and_passing_car(rng, simulator):
    """World with a car parked 7 to 9 m from the middle of the road, and a passing car."""
    position = np.array([rng.uniform(-4.0, 4.0), rng.choice([-1.0, 1.0]) * rng.uniform(7.0, 9.0)])
    stop = Ride(Path(position, 0.0, 1.0), (0.0, 1.0), (0.0, 0.0))
    speed = rng.uniform(7.0, 15.0)
    path, start_m = lane(rng, speed)
    return world(ROAD, [(car(rng, simulator), stop), (car(rng, simulator), path)],
                 2.0 * start_m / speed, rng, FLAWS[simulator])


def two_cars(rng, simulator, pattern, network=ROAD):
    """World with two cars that 'meet', 'overtake' or 'follow' each other at the sensors."""
    speed = rng.uniform(7.0, 14.0)
    y = rng.uniform(1.0, 1.6)
    start_m = QUIET_S * speed + 30.0
    first = Path(np.array([-start_m, -y]), 0.0, speed)
    if pattern == 'meet':
        other = speed * rng.uniform(0.8, 1.2)
        second = Path(np.array([start_m / speed * other + rng.uniform(-5.0, 5.0), y]), np.pi, other)
    elif pattern == 'overtake':
        other = speed * rng.uniform(1.3, 1.7)
        second = Path(np.array([-start_m / speed * other + rng.uniform(-5.0, 5.0), y]), 0.0, other)
    else:
        second = Path(np.array([-start_m - speed * rng.uniform(1.0, 2.0), -y]), 0.0, speed)
    movers = [(car(rng, simulator), first), (car(rng, simulator), second)]
    return world(network, movers, 2.0 * start_m / speed + 4.0, rng, FLAWS[simulator])


def fault_world(rng, simulator, *faults):
    """World with a car that passes sensors with faults of `support.spoiler`."""
    clean = straight(rng, simulator, car(rng, simulator), rng.uniform(7.0, 20.0))
    return replace(clean, readings=spoiler.apply(clean.readings, *faults))


def random_pass_world(rng, simulator, kind):
    """World with a random pass of `support.random_passes`."""
    seed = int(rng.integers(1 << 30))
    body, course, duration, flaws = random_pass(simulator, kind, seed)
    return world(ROAD, [(body, course)], duration, rng, flaws)


# Worlds without a target, or with one during a disturbance.

def ambient_world(rng, simulator, ambient, duration, rate=100.0, cars=0):
    """World with an `ambient` field, and optionally with passing cars."""
    movers = []
    for k in range(cars):
        speed = rng.uniform(7.0, 15.0)
        path, _ = lane(rng, speed, start_m=speed * (duration / cars * (k + 0.6)))
        movers.append((car(rng, simulator), path))
    return world(ROAD, movers, duration, rng, FLAWS[simulator], rate, ambient)


def uniform(vector, of_time):
    """Ambient field that is equal at all sensors: `vector` (3,) [T] times a function of time."""
    return lambda t: np.broadcast_to(of_time(t)[:, None, None] * vector, (len(t), len(ROAD), 3))


def direction(rng):
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def hum(rng, simulator, frequency, rate):
    """World with the field of a power line, which has a different amplitude at each sensor."""
    near = rng.uniform(0.5, 1.0, 2)
    v = rng.uniform(1e-7, 3e-7) * direction(rng)
    omega = 2.0 * np.pi * frequency * rng.uniform(0.9995, 1.0005)
    return ambient_world(rng, simulator, lambda t: np.sin(omega * t)[:, None, None]
                         * near[:, None] * v, 60.0, rate)


def tram(rng, simulator):
    """World with a tram line 30 to 60 m away, whose current of 100 to 500 A is switched."""
    times = np.sort(rng.uniform(12.0, 55.0, 4))
    distance, current = rng.uniform(30.0, 60.0), rng.uniform(100.0, 500.0)
    y = ROAD.positions[:, 1]
    # Field of an infinite wire along x, 5 m above the ground.
    r2 = (distance - y)**2 + 25.0
    B = 2e-7 * current * np.stack([0.0 * y, 5.0 / r2, (distance - y) / r2], axis=1)
    ramp = rng.uniform(0.2, 2.0)
    return ambient_world(rng, simulator, lambda t: np.interp(
        t, np.concatenate([[s, s + ramp] for s in times]), [0, 1, 1, 0, 0, 1, 1, 0]
    )[:, None, None] * B, 65.0)


def storm(rng, simulator, cars=0):
    """World with two minutes of a geomagnetic storm: slow waves, and a drift of 50 nT/min."""
    v = 5e-7 * direction(rng)
    periods, phases = rng.uniform(60.0, 400.0, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    return ambient_world(rng, simulator, uniform(v, lambda t: sum(
        np.sin(2.0 * np.pi * t / p + f) for p, f in zip(periods, phases, strict=True)) / 3.0
        + t / 600.0), 120.0, cars=cars)


def pulsations(rng, simulator):
    """World with geomagnetic pulsations of 20 nT and a period of 20 to 60 s."""
    p = rng.uniform(20.0, 60.0)
    return ambient_world(rng, simulator, uniform(
        2e-8 * direction(rng), lambda t: np.sin(2.0 * np.pi * t / p)), 120.0)


def knocked_sensor(rng, simulator):
    """World in which a sensor is suddenly rotated by 1 to 5 degrees."""
    quiet = ambient_world(rng, simulator, None, 40.0)
    angles = np.deg2rad(rng.uniform(1.0, 5.0)) * direction(rng)
    n = int(15.0 * 100.0) * 2
    field = quiet.readings.field.copy()
    rotated = np.flatnonzero(quiet.readings.sensor == 0)
    rotated = rotated[rotated >= n]
    field[rotated] += np.cross(field[rotated], angles)
    return replace(quiet, readings=replace(quiet.readings, field=field))


def drifting_sensors(rng, simulator):
    """World in which each sensor drifts by up to 5 nT/s for 10 to 30 s, then back."""
    rates = rng.uniform(1e-9, 5e-9, (2, 1)) * np.array([direction(rng), direction(rng)])
    ramp_s = rng.uniform(10.0, 30.0)
    return ambient_world(rng, simulator, lambda t: np.interp(
        t, [12.0, 12.0 + ramp_s, 12.0 + 2 * ramp_s], [0.0, ramp_s, 0.0])[:, None, None] * rates,
        90.0)


def distant_body(rng, simulator, body):
    """World with a large body that passes far away, with a hardly measurable field."""
    return straight(rng, simulator, body, rng.uniform(15.0, 25.0), start_m=200.0,
                    y=rng.choice([-1.0, 1.0]) * rng.uniform(30.0, 60.0))


def train(rng, simulator, y):
    """World with a train of five wagons of 18 m; a pose near the middle of any wagon is correct."""
    speed = rng.uniform(10.0, 20.0)
    path, start_m = lane(rng, speed, start_m=250.0, y=rng.choice([-1.0, 1.0]) * y)
    along = np.array([np.cos(path.heading), np.sin(path.heading)])
    movers = [(wagon(rng, simulator), replace(path, start=path.start + 20.0 * k * along))
              for k in range(-2, 3)]
    return world(ROAD, movers, 2.0 * start_m / speed, rng, FLAWS[simulator])
