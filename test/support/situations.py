"""Situations that violate the assumptions of the tracker's model, and evaluation of its poses."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.event_records import Disturbance
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import SmoothedPose, Track
from support import spoiler
from support.random_passes import SIMULATORS, are_wrong, errors_of
from support.situation_worlds import (
    FOUR,
    car,
    car_with_trailer,
    departing_car,
    distant_body,
    drifting_sensors,
    fault_world,
    hum,
    knocked_sensor,
    parked_and_passing_car,
    pulsations,
    random_pass_world,
    small,
    stopping_car,
    storm,
    straight,
    train,
    tram,
    truck,
    two_cars,
    u_turn,
)


@dataclass(frozen=True)
class Situation:
    """Entry of `SITUATIONS`."""

    make: object
    """Function from a random generator and the name of a simulator to a `World`."""
    aim: float = 0.02
    """Maximum proportion of wrong poses among the unflagged poses."""
    group: str = 'one'
    """'control' (tracked well), 'one' vehicle, 'several' vehicles, or 'nothing' (no target)."""


SITUATIONS = {
    'a car': Situation(lambda r, s: random_pass_world(r, s, 'car'), group='control'),
    'a truck': Situation(lambda r, s: random_pass_world(r, s, 'truck'), group='control'),
    'a car that turns': Situation(lambda r, s: random_pass_world(r, s, 'turning'), group='control'),
    'a car of 25 to 40 m/s': Situation(
        lambda r, s: straight(r, s, car(r, s), r.uniform(25.0, 40.0)), group='control'),
    'a U-turn': Situation(u_turn, group='control'),
    'a car, four sensors': Situation(
        lambda r, s: straight(r, s, car(r, s), r.uniform(7.0, 20.0), FOUR), group='control'),
    'a car of 60 m/s': Situation(lambda r, s: straight(r, s, car(r, s), 60.0)),
    'clocks 50 ms apart': Situation(lambda r, s: fault_world(r, s, spoiler.delayed('mag_2', 0.05))),
    'clocks 100 ms apart': Situation(lambda r, s: fault_world(r, s, spoiler.delayed('mag_2', 0.1))),
    'clocks 200 ms apart': Situation(lambda r, s: fault_world(r, s, spoiler.delayed('mag_2', 0.2))),
    'over a sensor': Situation(lambda r, s: straight(
        r, s, car(r, s), r.uniform(7.0, 20.0), y=r.choice([-4.5, 4.5]) + r.uniform(-0.4, 0.4))),
    'stops for 5 s': Situation(lambda r, s: stopping_car(r, s, 5.0)),
    'stops for 20 s': Situation(lambda r, s: stopping_car(r, s, 20.0)),
    'stops for 60 s': Situation(lambda r, s: stopping_car(r, s, 60.0)),
    'parks': Situation(lambda r, s: stopping_car(r, s, 60.0, 0.0)),
    'reverses': Situation(lambda r, s: stopping_car(r, s, 2.0, -0.5)),
    'crawls at 0.3 m/s': Situation(lambda r, s: straight(r, s, car(r, s), 0.3, start_m=15.0)),
    'a trolley at 1.3 m/s': Situation(lambda r, s: straight(
        r, s, small(r, s, 1.0, r.uniform(8.0, 15.0), 0.1), 1.3, start_m=20.0,
        y=r.choice([-1.0, 1.0]) * r.uniform(2.0, 3.5))),
    'a bicycle': Situation(lambda r, s: straight(
        r, s, small(r, s, 1.7, r.uniform(4.0, 8.0), 0.1), r.uniform(4.0, 7.0),
        y=r.choice([-1.0, 1.0]) * r.uniform(2.0, 3.5))),
    'a motorcycle': Situation(lambda r, s: straight(
        r, s, small(r, s, 2.1, r.uniform(40.0, 60.0)), r.uniform(8.0, 18.0))),
    'a car with a trailer': Situation(lambda r, s: straight(
        r, s, car_with_trailer(r, s), r.uniform(7.0, 15.0))),
    # The distance is from the nearer sensor.
    'a train at 9 m': Situation(lambda r, s: train(r, s, 13.5)),
    'there at the start, leaves': Situation(departing_car),
    'there at the start, then cars': Situation(lambda r, s: departing_car(r, s, cars=2)),
    # The stop is longer than `relearn_s`, so the vehicle has become part of the background.
    'was parked for minutes, leaves': Situation(lambda r, s: stopping_car(r, s, 150.0)),
    'parked beside a passing car': Situation(parked_and_passing_car),
    'one sensor alone': Situation(lambda r, s: fault_world(r, s, spoiler.only_sensor('mag_1'))),
    'one axis flipped': Situation(lambda r, s: fault_world(r, s, spoiler.wrong_sign('mag_2', 'y'))),
    'clipped at half its peak': Situation(lambda r, s: fault_world(r, s, spoiler.clipped(0.5))),
    'warming by 10 nT/s': Situation(lambda r, s: fault_world(r, s, spoiler.drift(1e-8))),
    'a temperature step': Situation(lambda r, s: fault_world(
        r, s, spoiler.temperature_step(3e-7, 4.0))),
    'two that meet': Situation(lambda r, s: two_cars(r, s, 'meet'), aim=0.05, group='several'),
    'one overtakes': Situation(lambda r, s: two_cars(r, s, 'overtake'), aim=0.05, group='several'),
    'one follows': Situation(lambda r, s: two_cars(r, s, 'follow'), aim=0.05, group='several'),
    'two that meet, four sensors': Situation(lambda r, s: two_cars(r, s, 'meet', FOUR), aim=0.05,
                                             group='several'),
    'one follows, four sensors': Situation(lambda r, s: two_cars(r, s, 'follow', FOUR), aim=0.05,
                                           group='several'),
    'hum of 50 Hz at 50 Hz': Situation(lambda r, s: hum(r, s, 50.0, 50.0), group='nothing'),
    'hum of 16.7 Hz at 100 Hz': Situation(lambda r, s: hum(r, s, 16.7, 100.0), group='nothing'),
    'a tram line switched': Situation(tram, group='nothing'),
    'a storm': Situation(storm, group='nothing'),
    'pulsations of 20 nT': Situation(pulsations, group='nothing'),
    'cars in a storm': Situation(lambda r, s: storm(r, s, cars=4)),
    'a sensor knocked': Situation(knocked_sensor, group='nothing'),
    'slow ramps': Situation(drifting_sensors, group='nothing'),
    'a truck far away': Situation(lambda r, s: distant_body(r, s, truck(r, s))),
    'a train far away': Situation(lambda r, s: train(r, s, r.uniform(40.0, 60.0))),
}
"""{name: situation}."""


def simulated_world(name, simulator, seed):
    """Simulate a situation; return a `World`."""
    rng = np.random.default_rng([seed, sorted(SITUATIONS).index(name),
                                 SIMULATORS.index(simulator)])
    return SITUATIONS[name].make(rng, simulator)


@dataclass(frozen=True)
class Verdict:
    """Evaluation of one `World`; the arrays have one element per published pose."""

    stamps: np.ndarray
    """Timestamp of each pose, (n,) s."""
    ids: np.ndarray
    ambiguous: np.ndarray
    wrong: np.ndarray
    """Whether the error exceeds 2 m and 3 standard deviations for every body, (n,)."""
    smoothed_unflagged: int
    smoothed_wrong: int
    n_tracks: int
    n_disturbances: int
    n_false_disturbances: int
    """Number of disturbances that were reported although their tracks follow a body."""
    doubts: tuple
    """Doubts of each pose."""

    @property
    def n_unflagged(self):
        return int((~self.ambiguous).sum())

    @property
    def n_wrong(self):
        return int((~self.ambiguous & self.wrong).sum())


def wrong_of(poses, a_world):
    """Whether each `Track` or `SmoothedPose` is wrong for every body of a `World`, (n,)."""
    wrong = np.ones(len(poses), dtype=bool)
    for position in a_world.positions:
        error, std, *_ = errors_of(poses, a_world.t, position)
        wrong &= are_wrong(error, std)
    return wrong


def false_disturbances(disturbances, tracks, a_world):
    """Select the disturbances whose tracks follow a body of a `World` (median error below 5 m)."""
    out = []
    for d in disturbances:
        poses = [r for r in tracks if r.id == d.track_id]
        error = [errors_of(poses, a_world.t, position)[0] for position in a_world.positions]
        if error and np.median(np.min(error, axis=0)) < 5.0:
            out.append(d)
    return out


def verdict(name, simulator, seed, changes=None):
    """Simulate and track a situation with the settings `changes`; return its `Verdict`."""
    a_world = simulated_world(name, simulator, seed)
    pipeline = Pipeline(a_world.network, settings_for('vehicle', changes))
    records = pipeline.feed(a_world.readings) + pipeline.flush()
    tracks = [r for r in records if isinstance(r, Track) and not r.ended]
    smoothed = [r for r in records if isinstance(r, SmoothedPose) and not r.ambiguous]
    disturbances = [r for r in records if isinstance(r, Disturbance) and r.ended]
    return Verdict(
        np.array([r.stamp_ns for r in tracks]) / 1e9, np.array([r.id for r in tracks]),
        np.array([r.ambiguous for r in tracks], dtype=bool), wrong_of(tracks, a_world),
        len(smoothed), int(wrong_of(smoothed, a_world).sum()), pipeline.track.counts['tracks'],
        len(disturbances), len(false_disturbances(disturbances, tracks, a_world)),
        tuple(r.doubts for r in tracks))
