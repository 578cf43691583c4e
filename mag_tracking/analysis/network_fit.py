"""Gauss and Newton for a network's geometry: weights, normal equations, steps.

Sensors and poses are tied by their readings only, so that poses are eliminated block by block.
"""

from typing import Protocol, TypeAlias

import numpy as np
from scipy.stats import chi2

from mag_tracking.analysis.network_readings import (
    POSE,
    SENSOR,
    SHARED,
    Prediction,
    TrackedMagnet,
    predicted_readings,
    tool_rotations,
)
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.network import SensorNetwork

OUTLYING = 1e-3
"""Readings less probable than this under the noise lose weight, the more the farther out."""

STEADY = 1e-3
"""A step is the last where its squared length, in posterior deviations, is below this."""

MAX_DAMPING = 1e10

Numbers: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Of the sensors (n, 10), shared (12,) and of the poses (K, 8)."""

Weights: TypeAlias = tuple[FloatArray, Numbers, float, FloatArray]
"""As `GeometryProblem.weights` returns them."""


class Priors(Protocol):
    """The prior deviations of `GeometrySettings` that the sensors' numbers have."""

    @property
    def gain_std(self) -> float:
        """Of a gain."""

    @property
    def rotation_std_deg(self) -> float:
        """[deg] Of an orientation, per axis."""

    @property
    def position_std(self) -> float:
        """[m] Of a position, per axis."""

    @property
    def field_error(self) -> float:
        """What the dipole errs by, relative to the field."""

    @property
    def iterations(self) -> int:
        """No more steps than these."""


class GeometryProblem:
    """What is given; the unknowns' units and priors; what is predicted, weighted.

    Parameters
    ----------
    network, field, positions, axes, moment, settings : as for `calibrate_geometry`, checked
    shared_unit : (12,)
        Prior deviations of what is shared; zero = fixed.
    pose_unit : (8,)
        The same of a pose.

    All x are (sensors (n, 10), shared (12,), poses (K, 8)) in these units.
    """

    def __init__(self, network: SensorNetwork, field: FloatArray, positions: FloatArray,
                 axes: FloatArray, moment: float, settings: Priors, shared_unit: FloatArray,
                 pose_unit: FloatArray) -> None:
        self.network, self.settings = network, settings
        self.shared_unit, self.pose_unit = shared_unit, pose_unit
        self.field = np.ascontiguousarray(np.swapaxes(field, 0, 1))
        self.variance = np.square(np.array(network.noise_std))[:, None]
        self.magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0),
                                    float(moment))
        self.heard: BoolArray = np.any(~np.isnan(self.field), axis=1)
        n = len(network)
        s = settings
        self.sensor_unit = np.hstack([
            np.array(network.noise_std), np.tile(np.repeat(
                [s.gain_std, np.deg2rad(s.rotation_std_deg), s.position_std], [1, 3, 3]), (n, 1))])

    def predicted(self, x: Numbers) -> Prediction:
        """As `predicted_readings`, by x in units of the priors."""
        sensor, shared, pose = self.in_si(x)
        f, signal, by_sensor, by_shared, by_pose = predicted_readings(
            self.network, self.magnet, sensor, shared, pose)
        return (f, signal, by_sensor * self.sensor_unit[:, None, None],
                by_shared * self.shared_unit, by_pose * self.pose_unit)

    def in_si(self, x: Numbers) -> Numbers:
        """Sensors' (n, 10), shared (12,) and poses' (K, 8) numbers of x."""
        sensor, shared, pose = x
        return sensor * self.sensor_unit, shared * self.shared_unit, pose * self.pose_unit

    def start(self) -> Numbers:
        """x with nothing corrected, and biases that are the middle of what is left over."""
        n, K = len(self.network), len(self.magnet.tool)
        x = np.zeros((n, SENSOR)), np.zeros(SHARED), np.zeros((K, POSE))
        left = self.field - self.predicted(x)[0]
        for j, a in zip(*np.nonzero(self.heard), strict=True):
            x[0][j, a] = np.nanmedian(left[j, :, a]) / self.sensor_unit[j, a]
        return x

    def misfit(self, f: FloatArray,
               signal: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Squared residuals over their variance (n, K, 3), how many (n, K), and the variance."""
        size2 = np.einsum('nki,nki->nk', signal, signal)[:, :, None]
        variance = self.variance + self.settings.field_error**2 * size2
        e2 = np.square(self.field - f) / variance
        return np.nan_to_num(e2), (~np.isnan(e2)).sum(axis=2), variance

    def weights(self, f: FloatArray, signal: FloatArray, x: Numbers) -> Weights:
        """Of readings (n, K, 3), of priors, as x is, the scale of the misfit, the trust (n, K)."""
        e2, count, variance = self.misfit(f, signal)
        d2 = e2.sum(axis=2)
        scale = max(1.0, float(np.median(typical(d2, count)[count > 0])))
        trust = _trust(d2 / scale, count)
        W = trust[:, :, None] / (variance * scale)
        W[np.isnan(self.field)] = 0.0
        return W, self._priors(x), scale, trust

    def _priors(self, x: Numbers) -> Numbers:
        """Weights of the priors, as x is."""
        # Only with the root: out of bounds is a fault, but one of what is asked for.
        sensor, pose = (np.sqrt(_trust(np.square(v).sum(axis=1), v.shape[1]))[:, None]
                        for v in (x[0][:, 3:], x[2]))
        # A bias has no prior; where an axis is silent, one that changes nothing.
        return (np.hstack([1.0 * ~self.heard, np.tile(sensor, SENSOR - 3)]), np.ones(SHARED),
                np.tile(pose, POSE))

    def cost(self, x: Numbers, f: FloatArray, W: FloatArray, priors: Numbers) -> float:
        """Sum of squares with given weights; infinite where it is no number."""
        e = np.nan_to_num(self.field - f)
        cost = (W * e * e).sum() + sum((w * v**2).sum() for w, v in zip(priors, x, strict=True))
        return cost if np.isfinite(f).all() else np.inf


def typical(d2: FloatArray, count: IntArray) -> FloatArray:
    """Squared residuals over their median under the noise; one where nothing was measured."""
    return np.where(count > 0, d2 / chi2.median(np.maximum(count, 1)), 1.0)


def _trust(d2: FloatArray, count: IntArray | int) -> FloatArray:
    """Weights of residuals with `count` numbers: one, then falling with the square."""
    limit = chi2.isf(OUTLYING, np.maximum(count, 1))
    return limit / np.maximum(d2, limit)


class NormalEquations:
    """Normal equations with the poses eliminated, block by block."""

    def __init__(self, problem: GeometryProblem, x: Numbers, predicted: Prediction, W: FloatArray,
                 priors: Numbers) -> None:
        f, _, by_sensor, by_shared, by_pose = predicted
        n, K = W.shape[:2]
        root = np.sqrt(W)
        e = (root * np.nan_to_num(problem.field - f)).reshape(n, 3 * K)
        Js, Jh = ((root[..., None] * J).reshape(n, 3 * K, -1) for J in (by_sensor, by_shared))
        Jp = root[..., None] * by_pose
        Jst = np.swapaxes(Js, 1, 2)
        m = SENSOR * n
        A = np.zeros((m + SHARED, m + SHARED))
        for j, block in enumerate(Jst @ Js):
            mine = slice(SENSOR * j, SENSOR * j + SENSOR)
            A[mine, mine] = block + np.diag(priors[0][j])
        A[:m, m:] = (Jst @ Jh).reshape(m, SHARED)
        A[m:, :m] = A[:m, m:].T
        Jh_all = Jh.reshape(-1, SHARED)
        A[m:, m:] = Jh_all.T @ Jh_all + np.diag(priors[1])
        self.A = A
        self.g = np.concatenate([
            (np.einsum('nyi,ny->ni', Js, e) - priors[0] * x[0]).ravel(),
            Jh_all.T @ e.ravel() - priors[1] * x[1]])
        by_k = np.swapaxes(Jp, 0, 1).reshape(K, 3 * n, POSE)
        self.A_pose = np.swapaxes(by_k, 1, 2) @ by_k + priors[2][:, :, None] * np.eye(POSE)
        self.g_pose = np.einsum('kyi,ky->ki', by_k, np.swapaxes(
            e.reshape(n, K, 3), 0, 1).reshape(K, 3 * n)) - priors[2] * x[2]
        across = np.einsum('nkai,nkap->knip', Js.reshape(n, K, 3, SENSOR), Jp)
        shared = np.einsum('nkai,nkap->kip', Jh.reshape(n, K, 3, SHARED), Jp)
        self.C = np.concatenate([across.reshape(K, m, POSE), shared], axis=1)

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Steps of [sensors, shared] (N,) and of the poses (K, 8)."""
        A, A_pose = self._damped(damping)
        CB = self.C @ np.linalg.inv(A_pose)
        S = A - self._reduced(CB)
        dx = np.linalg.solve(S, self.g - np.einsum('kip,kp->i', CB, self.g_pose))
        rest = self.g_pose - np.einsum('kip,i->kp', self.C, dx)
        return dx, np.linalg.solve(A_pose, rest[..., None])[..., 0]

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """Of [sensors, shared] (N, N) and of every pose (K, 8, 8)."""
        B = np.linalg.inv(self.A_pose)
        CB = self.C @ B
        P = np.linalg.inv(self.A - self._reduced(CB))
        P = 0.5 * (P + P.T)
        return P, B + np.swapaxes(CB, 1, 2) @ (P @ CB)

    def _reduced(self, CB: FloatArray) -> FloatArray:
        """What the poses take away (N, N)."""
        N = len(self.g)
        taken: FloatArray = (np.swapaxes(CB, 0, 1).reshape(N, -1)
                             @ np.swapaxes(self.C, 0, 1).reshape(N, -1).T)
        return taken

    def _damped(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Both diagonals, a little larger."""
        return (self.A + damping * np.diag(np.diagonal(self.A)),
                self.A_pose * (1.0 + damping * np.eye(POSE)))


def solve(problem: GeometryProblem,
          iterations: int) -> tuple[Numbers, Weights, Prediction, bool]:
    """The minimum, from nothing corrected.

    Returns
    -------
    x : as for `GeometryProblem`
    weights : (W, priors, scale, trust) as of `GeometryProblem.weights`
    predicted : as of `GeometryProblem.predicted`
    converged : bool
    """
    x, damping, converged = problem.start(), 1e-3, False
    predicted = problem.predicted(x)
    for _ in range(iterations):
        weights = problem.weights(predicted[0], predicted[1], x)
        W, priors = weights[:2]
        normal = NormalEquations(problem, x, predicted, W, priors)
        cost = problem.cost(x, predicted[0], W, priors)
        while damping < MAX_DAMPING:
            dx, dpose = normal.step(damping)
            trial = _moved(x, dx, dpose)
            there = problem.predicted(trial)
            if problem.cost(trial, there[0], W, priors) <= cost:
                break
            damping *= 10.0
        else:
            break
        x, predicted, damping = trial, there, 0.1 * damping
        if dx @ normal.g + (dpose * normal.g_pose).sum() < STEADY:
            converged = True
            break
    weights = problem.weights(predicted[0], predicted[1], x)
    return x, weights, predicted, converged


def _moved(x: Numbers, dx: FloatArray, dpose: FloatArray) -> Numbers:
    """x after a step."""
    m = len(dx) - SHARED
    return x[0] + dx[:m].reshape(-1, SENSOR), x[1] + dx[m:], x[2] + dpose
