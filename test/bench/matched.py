"""Error of the tracker relative to the Cramér-Rao bound, for targets that match its model.

Points and rows of three dipoles are drawn from a wide prior, moved with the process noise of the
model and measured with the noise of two sensors. The tracker starts at the first frame. The bound
is the covariance of a filter that is linearised at the truth and starts with the covariance
of the prior. The figures are the ratio of error to bound in the last half of each run, which is 1
at best, and the fraction of runs with an error above 2 m at the end.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from scipy.linalg import block_diag
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.inference.crlb import path_bound
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0, sensor_fields
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.initiation_vehicle import REFERENCE_FIELD, vehicle_model
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.units import NS
from support.process_noise import predicted

PERIOD, SIGMA, STEPS = 0.08, 1.2e-8 / np.sqrt(8.0), 26
NETWORK = SensorNetwork(
    ('mag_1', 'mag_2'), np.array([[0.0, -4.5, 0.0], [0.0, 4.5, 0.0]]),
    np.tile(np.eye(3), (2, 1, 1)), ('/mag_1/imu/mag', '/mag_2/imu/mag'),
    earth_field=np.array([2e-6, 1.55e-5, -4.9e-5]))
MATCHED = {'track.mounting_std_deg': 0.0, 'track.model_error_time_s': 0.0,
           'track.end_std': 1e6, 'track.end_nis': 1e12, 'track.field_error': 0.0,
           'track.vehicle.arrival_names': ['left'], 'track.vehicle.arrival_headings_deg': [0.0],
           'track.vehicle.turn_acceleration': 0.0,
           'track.vehicle.speeds': [7.0, 10.0, 14.0], 'track.vehicle.induced_share': 0.0,
           'track.vehicle.induced_share_std': 0.1, 'track.background_std': 1e-8,
           'track.background_drift': 1e-9, 'track.vehicle.acceleration': 0.3,
           'track.vehicle.moment_drift': 0.01, 'track.vehicle.difference_drift': 0.005,
           'track.vehicle.kinds.names': ['car']}


def car(length, length_std, difference_std):
    """Settings of the only kind of vehicle, whose model is exact."""
    values = {'length': length, 'length_std': length_std, 'difference_std': difference_std,
              'near_field_length': 0.0}
    return MATCHED | {f'track.vehicle.kinds.car.{name}': v for name, v in values.items()}


TARGETS = {'point': car(0.0, 0.0, 0.0),
           'row of three': {**car(3.0, 0.5, 30.0), 'track.vehicle.dipoles': 3}}


def prior_of(settings, n_t):
    """Mean and covariance of the prior: the target starts 12 m before the sensors, along x."""
    v = settings.vehicle
    kind, = v.kinds
    x, P = np.zeros(n_t + 6), np.zeros((n_t + 6, n_t + 6))
    assert v.induced_share == 0.0
    d = vehicle_model(v, NETWORK).n_dipoles
    hard = 6 + 3 * d
    x[[0, 2, 3]] = -12.0, kind.height, 10.0
    x[hard + 3:n_t] = kind.length
    std = np.r_[2.0, 2.0, kind.height_std, 3.0, 0.5, 0.05]
    P[:6, :6] = np.diag(std**2)
    mean = np.full((d, d), 1.0 / d)
    P[6:hard, 6:hard] = np.kron(kind.moment**2 / 3.0 / d * mean
                                + kind.difference_std**2 * (np.eye(d) - mean), np.eye(3))
    soft_iron_std = v.induced_share_std * kind.moment * MU0 / REFERENCE_FIELD
    P[hard:hard + 3, hard:hard + 3] = soft_iron_std**2 * (1.0 + np.eye(3))
    P[hard + 3:n_t, hard + 3:n_t] = kind.length_std**2
    P[n_t:, n_t:] = settings.background_std**2 * np.eye(6)
    return x, P


def truths(model, settings, rng):
    """Draw a true trajectory; return the lists of states (n_x,), F and Q, one entry per step."""
    n_t = len(model.state_names)
    x0, P0 = prior_of(settings, n_t)
    states, F, Q = [rng.multivariate_normal(x0, P0, method='eigh')], [np.eye(n_t + 6)], []
    Q.append(np.zeros((n_t + 6, n_t + 6)))
    walk = settings.background_drift**2 * PERIOD * np.eye(6)
    for _ in range(STEPS - 1):
        propagated, F_t, Q_t = predicted(model, states[-1][None, :n_t], PERIOD)
        F.append(block_diag(F_t, np.eye(6)))
        Q.append(block_diag(Q_t[0], walk))
        states.append(np.append(propagated[0], states[-1][n_t:])
                      + rng.multivariate_normal(np.zeros(n_t + 6), Q[-1], method='eigh'))
    return states, F, Q


def one_run(target, seed):
    """Track one target; return (horizontal error [m], bound on its RMS [m]) at each step."""
    settings = settings_for('vehicle', TARGETS[target]).track
    model, rng = vehicle_model(settings.vehicle, NETWORK), np.random.default_rng(seed)
    n_t = len(model.state_names)
    states, F, Q = truths(model, settings, rng)
    stage, errors, H = TrackManager(NETWORK, settings), [], []
    for k, truth in enumerate(states):
        h, H_t, _ = sensor_fields(NETWORK.positions, NETWORK.R_sw,
                                  *model.dipoles(truth[None, :n_t]))
        H.append(np.hstack([H_t[0].reshape(6, n_t), np.eye(6)]))
        y = h[0] + truth[n_t:].reshape(2, 3) + SIGMA * rng.standard_normal((2, 3))
        stage.feed(FieldFrame(round(k * PERIOD * NS), y, np.tile(SIGMA**2 * np.eye(3), (2, 1, 1)),
                              np.full(2, 8), np.zeros(2), True))
        errors.append(np.linalg.norm((stage.bank.x[stage.bank.best()] - truth)[:2]))
    bound = path_bound(np.array(F), np.array(Q), np.array(H), SIGMA**2 * np.eye(6),
                       prior_of(settings, n_t)[1])
    return np.array(errors), np.sqrt(bound[:, 0, 0] + bound[:, 1, 1])


def main(n=200):
    """Print a line for each kind of target."""
    figures = Figures('matched')
    print(f'{n} matched runs, two sensors, wide prior, the last half of each pass')
    with ProcessPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        for target in TARGETS:
            jobs = [pool.submit(one_run, target, seed) for seed in range(n)]
            found = [j.result() for j in tqdm(jobs, desc=target, disable=None, leave=False)]
            error, bound = (np.array(a)[:, STEPS // 2:] for a in zip(*found, strict=True))
            rms = np.sqrt((error**2).mean(axis=1))
            ratios = []
            for fraction in (0.05, 0.1):
                selected = np.argsort(rms)[:round(n * (1.0 - fraction))]
                ratio = np.sqrt((error[selected]**2).mean() / (bound[selected]**2).mean())
                figures.record(
                    f'{target}: error over the path bound, without the worst {fraction:.0%}', ratio)
                ratios.append(f'{ratio:.2f} without the worst {fraction:.0%}')
            median = np.median(rms / np.sqrt((bound**2).mean(axis=1)))
            figures.record(f'{target}: error over the path bound, median of the runs', median)
            figures.record(f'{target}: failures (> 2 m at the end)',
                           100.0 * np.mean(error[:, -1] > 2.0), '%')
            print(f'  {target}: error over path bound {", ".join(ratios)}, median of the runs '
                  f'{median:.2f}; failures (> 2 m at the end) {np.mean(error[:, -1] > 2.0):.1%}',
                  flush=True)
    figures.save()
    return 0


if __name__ == '__main__':
    sys.exit(main())
