"""Sample streams of a vehicle's pass with one faulty sensor."""

from dataclasses import replace

import numpy as np

from mag_tracking.simulation.scenario import Path
from support.networks import line_network
from support.samples import simulate
from support.scenario import point_body

START_S = 1000.0
SPEED = 10.0
INITIAL_POSITION = np.array([-60.0, -1.5])
FULL_SCALE = 8e-4
"""[T] Full scale of a sensor; a spike of 2000 times full scale is 1.6 T."""
NS = 1_000_000_000


def swap_axes(sample, rng):
    """Fault that swaps the x and y axes."""
    return [replace(sample, field=sample.field[[1, 0, 2]])]


def with_spikes(size):
    """Fault that adds a spike of +/- `size` [T] on every axis, with a probability of 5 %."""
    def modify(sample, rng):
        spike = size * rng.choice([-1.0, 1.0], 3) if rng.random() < 0.05 else 0.0
        return [replace(sample, field=sample.field + spike)]
    return modify


def shift_clock(seconds):
    """Fault that sets the clock back by `seconds`, or ahead if negative."""
    return lambda sample, rng: [replace(sample, stamp_ns=sample.stamp_ns - round(seconds * NS))]


class Frozen:
    """Fault that repeats the first reading."""

    def __init__(self):
        self._field = None

    def __call__(self, sample, rng):
        self._field = sample.field if self._field is None else self._field
        return [replace(sample, field=self._field)]


FAULTS = {
    'dies': lambda: lambda sample, rng: [],
    'freezes': Frozen,
    'spikes of 2000 times full scale': lambda: with_spikes(2000.0 * FULL_SCALE),
    'spikes within full scale': lambda: with_spikes(0.6 * FULL_SCALE),
    'small spikes': lambda: with_spikes(2e-6),
    'swaps axes': lambda: swap_axes,
    'jumps 1 s ahead': lambda: shift_clock(-1.0),
    'jumps 1 s back': lambda: shift_clock(1.0),
    'sends duplicates': lambda: lambda sample, rng: [sample, sample],
    'sends gauss': lambda: lambda sample, rng: [replace(sample, field=1e4 * sample.field)],
}


def stream(n_sensors, seed, fault=None, lasting_s=1.5, sensor='mag_2'):
    """Simulate a pass with a fault of `sensor`.

    Returns (network, samples, truth: t [s] -> position (2,) [m], (begin, end) of the fault [s]).
    """
    network = line_network(n_sensors, tilt=0.0)
    rng = np.random.default_rng(seed)
    farthest = float(network.positions[:, 0].max())
    body = point_body(rng.normal(0.0, 250.0, 3), 5.0, 0.5)
    duration = (60.0 + farthest + 60.0) / SPEED
    samples, *_ = simulate(network, body, Path(INITIAL_POSITION, 0.0, SPEED), 100.0, duration, rng,
                           start_s=START_S)
    begin = START_S + 6.0 + max(0.0, farthest / 2.0 - 5.0) / SPEED - 0.4
    end = begin + lasting_s
    modify, out = None if fault is None else FAULTS[fault](), []
    for sample in samples:
        is_faulty = modify and sample.sensor == sensor and begin <= sample.stamp_ns / NS < end
        out += modify(sample, rng) if is_faulty else [sample]

    def truth(t):
        return INITIAL_POSITION + [SPEED * (t - START_S), 0.0]
    return network, out, truth, (begin, end)
