"""Labelled signatures of simulated vehicles that pass one roadside sensor."""

import csv

import numpy as np

from mag_tracking.analysis.signature import Signature
from support.passes import EARTH
from support.situation_worlds import car, small, truck

SENSOR = np.array([[0.0, 0.0, 0.0]])
RATE = 50.0
NOISE = 2e-8


def body_of(rng, name, simulator):
    if name == 'motorcycle':
        return small(rng, simulator, 2.1, rng.uniform(40.0, 120.0))
    return (car if name == 'car' else truck)(rng, simulator)


def signature(rng, name, simulator, n_axes=3):
    """Signature of one pass at a random speed and distance, with drift and noise."""
    body, speed = body_of(rng, name, simulator), rng.uniform(8.0, 25.0)
    lateral = rng.uniform(2.0, 4.0)
    half = 20.0 / speed + rng.uniform(0.0, 1.0)
    t = np.arange(0.0, 2.0 * half, 1.0 / RATE)
    direction = rng.choice([-1.0, 1.0])
    position = np.stack([direction * speed * (t - half), np.full(len(t), lateral)], axis=1)
    heading = np.full(len(t), 0.0 if direction > 0 else np.pi)
    B = body.field(EARTH, position, heading, SENSOR)[:, 0]
    B = B + NOISE * rng.standard_normal(B.shape) + 1e-8 * rng.standard_normal(3) * t[:, None]
    return Signature(t, B[:, :n_axes], name, f'{name} of {simulator}', tuple('xyz'[:n_axes]), 'T',
                     str(rng.random()))


def signatures(counts, simulator, seed=0, n_axes=3):
    """Generate random signatures; `counts` is {class: number of signatures}."""
    rng = np.random.default_rng(seed)
    return [signature(rng, name, simulator, n_axes) for name, n in counts.items()
            for _ in range(n)]


def write_by_sample(path, signatures, unit=1e9):
    with open(path, 'w', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(['label', 'signature', 'time_s', 'x_nt', 'y_nt', 'z_nt'])
        for k, s in enumerate(signatures):
            writer.writerows([s.label, k, t, *(unit * b)]
                             for t, b in zip(s.t, s.field, strict=True))


def write_by_row(path, signatures, n=80):
    """Write signatures resampled to `n` samples, one per row."""
    with open(path, 'w', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(['label', *(f'{a}_nt_{k}' for a in 'xyz' for k in range(n))])
        for s in signatures:
            times = np.linspace(s.t[0], s.t[-1], n)
            writer.writerow([s.label, *(1e9 * v for axis in s.field.T
                                        for v in np.interp(times, s.t, axis))])
