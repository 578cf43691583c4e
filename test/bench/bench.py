"""Update of the filter bank, compared with loops of filterpy filters.

A bank of hypotheses of a point vehicle is updated with one frame of 2 to 100 sensors. Two
peers compute the same update with a loop of filterpy EKFs. The model of the first peer loops over
the sensors; the model of the second peer is vectorised. Each figure is the ratio of the peer's time
to the bank's time, as the median over rounds. Both times are measured alternately on one thread.
The aims are ratios of 350, 120, 40 and 25 for 2, 8, 32 and 100 sensors, against the first peer.
"""

import os

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS'):
    os.environ[_name] = '1'

import sys  # noqa: E402  (the thread counts have to be set before NumPy is loaded)
import time  # noqa: E402

import numpy as np  # noqa: E402
from filterpy.kalman import ExtendedKalmanFilter  # noqa: E402

from bench.figures import Figures  # noqa: E402
from mag_tracking.geometry import (  # noqa: E402
    cross_matrix,
    quaternion_from_rotation_vector,
    rotation_from_quaternion,
)
from mag_tracking.inference.filter_bank import FilterBank  # noqa: E402
from mag_tracking.network import SensorNetwork  # noqa: E402
from mag_tracking.physics.dipole import MU0, sensor_fields  # noqa: E402
from mag_tracking.physics.vehicles import RowVehicle  # noqa: E402
from mag_tracking.pipeline import settings_for  # noqa: E402
from mag_tracking.records import FieldFrame  # noqa: E402
from mag_tracking.stages.track.bank_filter import BankFilter  # noqa: E402
from support.bundled import POINT  # noqa: E402

EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])
SIGMA = 4e-9


N_TARGET = 12
"""Number of states of a point target."""


def moment(x):
    """Magnetic moment (3,) [A m²] of a vehicle with the state `x` (12,), and its Jacobian (3, 12).

    ICASSP11 eq. (8), with a tensor that is diagonal in the axes of the vehicle.
    """
    speed2 = x[3] ** 2 + x[4] ** 2
    c, s = x[3] / np.sqrt(speed2), x[4] / np.sqrt(speed2)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    b = R.T @ EARTH / MU0
    m = R @ (x[6:9] + x[9:12] * b)
    # z x m, minus the effect of the rotation of b in the axes of the vehicle. np.cross would slow
    # the peer down.
    rotation_of_b = R @ (x[9:12] * [-b[1], b[0], 0.0])
    by_heading = np.array([-m[1], m[0], 0.0]) - rotation_of_b
    J = np.zeros((3, N_TARGET))
    J[:, 3:5] = np.outer(by_heading, [-x[4], x[3]]) / speed2
    J[:, 6:9] = R
    J[:, 9:12] = R * b
    return m, J


def dipole(d, m):
    """Field (3,) [T] of a dipole `m` at the relative position `d`; Jacobians in `d` and `m`."""
    n2 = d @ d
    k3 = 1e-7 / n2**1.5
    dm = d @ m
    B = k3 * (3.0 * dm / n2 * d - m)
    J_m = k3 * (3.0 * np.outer(d, d) / n2 - np.eye(3))
    J_d = 3.0 * k3 / n2 * (dm * np.eye(3) + np.outer(d, m) + np.outer(m, d)
                           - 5.0 * dm / n2 * np.outer(d, d))
    return B, J_d, J_m


class Peer:
    """Loop of filterpy EKFs, each with a NumPy model that loops over the sensors.

    The state contains the target (12), three mounting angles per sensor if they are estimated, and
    three background components per sensor.
    """

    def __init__(self, positions, R_sw, x, P):
        self.positions, self.R_sw = positions, R_sw
        self.n = 3 * len(positions)
        self.has_mounting = x.shape[1] > N_TARGET + self.n
        self.filters = []
        for xi, Pi in zip(x, P, strict=True):
            f = ExtendedKalmanFilter(x.shape[1], self.n)
            f.x, f.P, f.R = xi.copy(), Pi.copy(), np.eye(self.n)
            self.filters.append(f)

    def fields(self, x):
        """Field of the target, (n_sensors, 3) [T], sensor frames."""
        m, _ = moment(x)
        return np.array([R @ dipole(position - x[:3], m)[0]
                         for position, R in zip(self.positions, self.R_sw, strict=True)])

    def jacobians(self, x):
        """Jacobian of `fields`, (n_sensors, 3, 12)."""
        m, J = moment(x)
        out = np.empty((len(self.positions), 3, N_TARGET))
        for j, (position, R) in enumerate(zip(self.positions, self.R_sw, strict=True)):
            _, J_d, J_m = dipole(position - x[:3], m)
            out[j] = R @ J_m @ J
            out[j, :, :3] -= R @ J_d
        return out

    def h(self, x):
        """Predicted measurement, divided by the standard deviation of the noise."""
        B = self.fields(x)
        if self.has_mounting:
            B = B + np.cross(x[N_TARGET:N_TARGET + self.n].reshape(-1, 3), B)
        return (B.ravel() + x[-self.n:]) / SIGMA

    def H(self, x):
        """Jacobian of `h`."""
        out = np.zeros((self.n, len(x)))
        J = self.jacobians(x)
        if self.has_mounting:
            J = J + cross_matrix(x[N_TARGET:N_TARGET + self.n].reshape(-1, 3)) @ J
            by_angle = -cross_matrix(self.fields(x))
            for j in range(len(J)):
                k = N_TARGET + 3 * j
                out[3 * j:3 * j + 3, k:k + 3] = by_angle[j]
        out[:, :N_TARGET] = J.reshape(self.n, N_TARGET)
        out[:, -self.n:] = np.eye(self.n)
        return out / SIGMA

    def update(self, y):
        """Update all filters with one measurement."""
        z = y.ravel() / SIGMA
        for f in self.filters:
            f.update(z, self.H, self.h)


class VectorPeer(Peer):
    """Loop of filterpy EKFs, each with a NumPy model that is vectorised over the sensors."""

    def _common(self, x):
        m, J = moment(x)
        d = self.positions - x[:3]
        n2 = np.einsum('ij,ij->i', d, d)
        k3, dm = 1e-7 / n2**1.5, d @ m
        return m, J, d, n2, k3, dm

    def fields(self, x):
        m, _, d, n2, k3, dm = self._common(x)
        B = k3[:, None] * (3.0 * (dm / n2)[:, None] * d - m)
        return (self.R_sw @ B[:, :, None])[..., 0]

    def jacobians(self, x):
        m, J, d, n2, k3, dm = self._common(x)
        dd = d[:, :, None] * d[:, None, :]
        J_m = k3[:, None, None] * (3.0 * dd / n2[:, None, None] - np.eye(3))
        cross = d[:, :, None] * m
        J_d = 3.0 * (k3 / n2)[:, None, None] * (
            dm[:, None, None] * np.eye(3) + cross + np.swapaxes(cross, 1, 2)
            - 5.0 * (dm / n2)[:, None, None] * dd)
        out = self.R_sw @ J_m @ J
        out[:, :, :3] -= self.R_sw @ J_d
        return out


def bank_case(n_sensors, n_hyp, rng, has_mounting):
    """Create a filter, the sensor poses, a bank of hypotheses near the truth and a frame.

    With `has_mounting`, the state includes the mounting angles of the sensors.
    """
    positions = np.zeros((n_sensors, 3))
    positions[:, 0] = 9.0 * (np.arange(n_sensors) // 2)
    positions[:, 1] = np.where(np.arange(n_sensors) % 2, 4.5, -4.5)
    R_sw = rotation_from_quaternion(quaternion_from_rotation_vector(
        0.2 * rng.standard_normal((n_sensors, 3))))
    model = RowVehicle(EARTH, np.ones(3), n_dipoles=1)
    names = tuple(f'mag_{j}' for j in range(n_sensors))
    network = SensorNetwork(names, positions, np.ascontiguousarray(np.swapaxes(R_sw, 1, 2)),
                            names, earth_field=EARTH)
    settings = settings_for('vehicle', {
        **POINT, 'track.vehicle.kinds.car.near_field_length': 0.0, 'track.field_error': 0.0,
        'track.model_error_time_s': 0.0,
        'track.mounting_std_deg': 5.0 if has_mounting else 0.0}).track
    n_mounting = 3 * n_sensors if has_mounting else 0
    x = np.zeros((n_hyp, N_TARGET + n_mounting + 3 * n_sensors))
    x[:, :3] = [-6.0, -1.0, 0.5] + 0.3 * rng.standard_normal((n_hyp, 3))
    x[:, 3:6] = [10.0, 0.0, 0.0] + 0.3 * rng.standard_normal((n_hyp, 3))
    x[:, 6:9] = 200.0 * rng.standard_normal((n_hyp, 3))
    x[:, 9:12] = [6.0, 5.0, 4.0]
    P = np.repeat(np.diag(np.r_[1.0, 1.0, 0.1, 4.0, 1.0, 0.01, [1e4] * 3, [4.0] * 3,
                                np.full(n_mounting, 0.0076), np.full(3 * n_sensors, 4e-16)])[None],
                  n_hyp, axis=0)
    y = sensor_fields(positions, R_sw, *model.dipoles(x[:1, :N_TARGET]))[0][0]
    frame = FieldFrame(0, y + SIGMA * rng.standard_normal(y.shape),
                       np.repeat(SIGMA**2 * np.eye(3)[None], n_sensors, axis=0),
                       np.full(n_sensors, 8), np.zeros(n_sensors), True)
    bank = FilterBank(x, P, np.zeros(n_hyp), np.zeros(n_hyp, dtype=int),
                      np.zeros(n_hyp, dtype=int), np.arange(n_hyp), np.zeros((n_hyp, n_sensors)))
    return BankFilter(network, model, settings), positions, R_sw, bank, frame


def bank_ratio(peer_class, n_sensors, has_mounting, n_hyp=64, rounds=12, repeats=100):
    """Time the updates; return (median, minimum, maximum ratio, bank time [us], peer time [us])."""
    rng = np.random.default_rng(n_sensors)
    bank_filter, positions, R_sw, bank, frame = bank_case(n_sensors, n_hyp, rng, has_mounting)
    x, P = bank.x, bank.P
    bank_times, peer_times = [], []
    for k in range(rounds + 1):
        peer = peer_class(positions, R_sw, x, P)
        start = time.perf_counter()
        peer.update(frame.field)
        t_peer = time.perf_counter() - start
        xi, Pi, t_bank = np.empty_like(x), np.empty_like(P), 0.0
        for _ in range(repeats):
            # The arrays are freshly written, as after a prediction. This also applies to the peer.
            xi[:], Pi[:] = x, P
            bank.x, bank.P = xi, Pi
            start = time.perf_counter()
            bank_filter.advance(bank, frame, 0.0)
            t_bank += (time.perf_counter() - start) / repeats
        worst = max(np.abs((f.x - a) / np.sqrt(np.diagonal(f.P))).max()
                    for f, a in zip(peer.filters, bank.x, strict=True))
        assert worst < 1e-6, f'bank and peer differ by {worst} standard deviations'
        if k:
            bank_times.append(t_bank)
            peer_times.append(t_peer)
    ratio = np.array(peer_times) / np.array(bank_times)
    return (np.median(ratio), ratio.min(), ratio.max(), 1e6 * np.median(bank_times),
            1e6 * np.median(peer_times))


def main():
    """Print the figures; return 1 if an aim is missed."""
    figures = Figures('bank')
    print('bank update against a loop of filterpy EKFs, one thread')
    for n_sensors, n_hyp, has_mounting, aim in (
            (2, 64, False, 350.0), (8, 64, False, 120.0), (32, 64, False, 40.0),
            (100, 16, False, 25.0), (2, 64, True, None), (8, 64, True, None)):
        for peer, peer_aim in ((Peer, aim), (VectorPeer, None)):
            rounds, repeats = (12, 100) if n_sensors <= 8 else (4, 3)
            ratio, low, high, bank_us, peer_us = bank_ratio(
                peer, n_sensors, has_mounting, n_hyp, rounds, repeats)
            state = 'target, backgrounds' + (', mounting' if has_mounting else '')
            kind = 'a model from sensor to sensor' if peer is Peer else 'a vectorised model'
            figures.add(f'{n_sensors} sensors x {n_hyp} hypotheses; {state}; {kind}', ratio,
                        'times', peer_aim, True,
                        f'  ({low:.0f} .. {high:.0f}; {bank_us:.0f} us against {peer_us:.0f} us)')
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
