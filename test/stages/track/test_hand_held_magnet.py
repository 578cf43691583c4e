"""A magnet in a hand above a board: accuracy, consistency and flags with the default settings."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.records import Readings, Track
from support.passes import EARTH

BOARD = '''sensors:
''' + ''.join(f'  mag_{3 * j + i}: {{position: [{0.1 * i:.1f}, {0.1 * j:.1f}, 0.0]}}\n'
              for j in range(3) for i in range(3))
RATE, QUIET_S, APPROACH_S, DURATION_S = 50.0, 5.0, 1.0, 14.0
MOMENT = 0.1


@pytest.fixture(scope='module')
def board(tmp_path_factory):
    """(path of the network file, network) of nine sensors a decimetre apart."""
    path = tmp_path_factory.mktemp('board') / 'board.yaml'
    path.write_text(BOARD)
    return path, read_network(path)


def smooth_motion(rng, t, period):
    """Sum of sines with periods of about `period` [s]: (n, 3), with a variance of 1."""
    frequency, phase = rng.uniform(0.5, 1.2, (5, 3)) / period, rng.uniform(0, 2 * np.pi, (5, 3))
    return np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1) * np.sqrt(2 / 5)


def hand_held(network, speed, spin, seed):
    """Readings of a magnet that moves and turns with these RMS rates [m/s], [rad/s].

    Returns (`Readings`, times (n,) [s], positions (n, 3) [m], directions of the moment (n, 3)).
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, DURATION_S, 1.0 / RATE)
    size = np.array([0.05, 0.05, 0.025])
    position = size * smooth_motion(rng, t, 2.0 * np.pi * np.linalg.norm(size) * 0.85 / speed)
    position += [0.1, 0.1, 0.13]
    position[:, 2] += np.clip(1.0 - (t - QUIET_S) / APPROACH_S, 0.0, 1.0)
    rate = spin / np.sqrt(3.0) * smooth_motion(rng, t, 1.5)
    attitude, axes = Rotation.random(random_state=seed), []
    for w in rate:
        axes.append(attitude.apply([0.0, 0.0, 1.0]))
        attitude = Rotation.from_rotvec(w / RATE) * attitude
    r = network.positions - position[:, None]
    d = np.linalg.norm(r, axis=2, keepdims=True)
    m = MOMENT * np.array(axes)[:, None]
    B = 1e-7 * (3.0 * r * (r * m).sum(axis=2, keepdims=True) / d**5 - m / d**3)
    B *= (t >= QUIET_S)[:, None, None]
    B += EARTH + 3e-6 * rng.standard_normal((9, 3)) + 1e-7 * rng.standard_normal(B.shape)
    readings = Readings(network.names, np.tile(np.arange(9), len(t)),
                        np.repeat(np.round(t * 1e9).astype(np.int64), 9), B.reshape(-1, 3))
    return readings, t, position, np.array(axes)


@pytest.mark.parametrize('speed', [0.09, 0.25, 0.5])
def test_a_magnet_in_a_hand_is_tracked_consistently(board, speed):
    _, network = board
    readings, t, position, axes = hand_held(network, speed, 3.0, 1)
    pipeline = Pipeline(network, settings_for('magnet'))
    tracks = [r for r in pipeline.feed(readings) + pipeline.flush()
              if isinstance(r, Track) and not r.ended
              and r.stamp_ns / 1e9 > QUIET_S + APPROACH_S + 0.2]
    assert len({r.id for r in tracks}) == 1 and len(tracks) > 350
    rows = np.rint(np.array([r.stamp_ns for r in tracks]) / 1e9 * RATE).astype(int)
    error = np.array([r.position for r in tracks]) - position[rows]
    P = np.array([r.covariance[:3, :3] for r in tracks])
    nees = np.einsum('ni,nij,nj->n', error, np.linalg.inv(P), error).mean() / 3.0
    angle = [np.degrees(np.arccos(r.moment @ u / np.linalg.norm(r.moment)))
             for r, u in zip(tracks, axes[rows], strict=True)]
    flagged = np.mean([r.ambiguous for r in tracks])
    print(f'{speed} m/s: median error {1e3 * np.median(np.linalg.norm(error, axis=1)):.2f} mm, '
          f'{np.median(angle):.2f} deg, NEES per axis {nees:.2f}, {flagged:.0%} flagged')
    assert np.median(np.linalg.norm(error, axis=1)) < 3e-3 and np.median(angle) < 3.0
    assert nees < 2.0 and flagged < 0.05
