"""Causes of the position error of a turning car at its closest point.

The recording `junction_left_turns_to_rear` is replayed with the network file, with exact clocks,
with exact mountings, and with other settings. The figures are the errors at the closest point. The
magnetic centre of the car is located by a least-squares fit of dipoles that move along the true
path. There is no aim.
"""

import json
import tempfile
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from bench.figures import Figures
from mag_tracking.apps.replay import replay
from mag_tracking.network.file import read_network
from mag_tracking.physics.dipole import MU0, dipole_field
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from support.bundled import NETWORK_FILE, vehicle_path
from support.live_runs import passes_of
from support.samples import one, recorded

NAME = 'junction_left_turns_to_rear'
NOISE = 1.2e-8
POINT, ROW = (0.0,), (-1.0, 0.0, 1.0)
"""Positions of the dipoles along the body, in half lengths."""
SETTINGS = {'iron three times as uneven': {
                'track.vehicle.kinds.car.difference_std': 90.0,
                'track.vehicle.kinds.truck.difference_std': 360.0},
            'speeds of 5 m/s only': {'track.vehicle.speeds': [5.0]},
            'acceleration 0.3': {'track.vehicle.acceleration': 0.3},
            'field error 0.01': {'track.field_error': 0.01}}


def network_with(mountings, clocks):
    """Network from the network file, optionally with exact mountings and exact clocks."""
    network = read_network(NETWORK_FILE)
    truth = json.loads(vehicle_path(NAME).with_suffix('.truth.json').read_text())['sensor_truth']
    if mountings:
        network = replace(network, R_ws=np.array(truth['mount_sensor_to_map']))
    if clocks:
        network = replace(network, clock_offset=1e-3 * np.array(truth['clock_offset_ms']))
    return network


def replay_recording(network, changes):
    """Replay the recording into a temporary folder; return the `Run`."""
    with tempfile.TemporaryDirectory() as out:
        return replay(Recording(vehicle_path(NAME)), network, settings_for('vehicle', changes), out)


def errors(network, changes, figures=None, name=''):
    """Replay the recording; record the errors of the track, and return a line with the errors."""
    track, = replay_recording(network, changes).summary['tracks']
    truth, smoothed = track['truth'], track['smoothed']['truth']
    if figures is not None:
        figures.record(f'{name}: error at the closest point', truth['closest'], 'm')
        figures.record(f'{name}: error at the closest point, smoothed', smoothed['closest'], 'm')
    return (f'closest {truth["closest"]:.2f} m, ANEES {truth["anees"]:.1f}; '
            f'smoothed {smoothed["closest"]:.2f} m')


def true_motion(data, truth):
    """Position (n, 3) and rotation (n, 3, 3) of the body at the samples of a `PassData`."""
    stamps, position, _ = truth
    t = (stamps - data.stamp_ns) / 1e9
    body_position, v = (np.stack([np.interp(data.t, t, column) for column in table.T], axis=1)
                        for table in (position, np.gradient(position, t, axis=0)))
    direction = v / np.linalg.norm(v, axis=1, keepdims=True)
    R = np.zeros((len(data.t), 3, 3))
    R[:, :2, 0], R[:, 2, 2] = direction[:, :2], 1.0
    R[:, 0, 1], R[:, 1, 1] = -direction[:, 1], direction[:, 0]
    return body_position, R


def magnetic_centre(network, row):
    """Fit dipoles that move along the true path.

    Returns (centre (3,) [m] in the body frame, half length [m], moments [A m²], normalised cost).
    """
    reader = SampleReader(Recording(vehicle_path(NAME)), network)
    (data, _), = passes_of(network, map(one, recorded(reader)))
    body_position, R = true_motion(data, next(iter(replay_recording(network, {}).truth.values())))
    y = np.einsum('nij,nj->ni', network.R_ws[data.sensor], data.field).ravel() / NOISE
    field_strength = network.earth_field / MU0
    backgrounds = np.kron(np.eye(len(network))[data.sensor], np.eye(3))

    def linear(p):
        columns = []
        for offset in row:
            r = data.positions - body_position - R @ (p[:3] + [offset * p[3], 0.0, 0.0])
            columns += [dipole_field(r, m).ravel() / NOISE for m in (
                *np.moveaxis(R, 2, 0), np.broadcast_to(field_strength, r.shape))]
        A = np.column_stack([*columns, backgrounds])
        scale = np.linalg.norm(A, axis=0)
        theta = np.linalg.lstsq(A / scale, y, rcond=None)[0]
        return y - A / scale @ theta, theta / scale

    found = least_squares(lambda p: linear(p)[0], [0.0, 0.0, 0.5, 1.3])
    iron = linear(found.x)[1][:4 * len(row)].reshape(-1, 4)
    moments = np.linalg.norm(iron[:, :3] + iron[:, 3:] * field_strength, axis=1)
    unknowns = (4 if len(row) > 1 else 3) + 4 * len(row) + 3 * len(network)
    return found.x[:3], found.x[3], moments, 2.0 * found.cost / (len(y) - unknowns)


def main():
    """Print the errors and the magnetic centres."""
    figures = Figures('junction_error')
    for name, exact in (('network file', (False, False)), ('exact clocks', (False, True)),
                        ('exact mountings', (True, False)), ('both exact', (True, True))):
        print(f'{name}: {errors(network_with(*exact), {}, figures, name)}', flush=True)
    for name, changes in SETTINGS.items():
        print(f'{name}: {errors(network_with(False, False), changes)}; '
              f'both exact: {errors(network_with(True, True), changes)}', flush=True)
    print('dipoles on the true path, both exact: centre forward, left, up from the true position')
    for name, row in (('a point', POINT), ('a row of three', ROW)):
        centre, half, moments, cost = magnetic_centre(network_with(True, True), row)
        shape = f', half length {half:.2f} m' if len(row) > 1 else ''
        print(f'  {name}: {centre.round(2)} m{shape}, moments {moments.round()} A m^2, rear first; '
              f'normalised cost {cost:.2f}')
    figures.save()


if __name__ == '__main__':
    main()
