"""Filters of a bank in NumPy, step by step, as an oracle for the compiled filters."""

import numpy as np

from mag_tracking.stages.track.bank_filter import BankFilter, PathResult
from support import plain_kalman
from support.plain_smoother import Step, smoothed_covariances, smoothed_states
from support.process_noise import predicted


class StepByStep:
    """Implementation of `BankFilter.run_along` by separate calls of `predict` and `update`."""

    def run_along(self, bank, frames, intervals, paths, *, passes, step, first_is_updated,
                  rejects_outliers=False, wants_covariances=False):
        start = bank.copy()
        for _ in range(passes):
            bank.x, bank.P = start.x.copy(), start.P.copy()
            steps, log_likelihood, used = self.filtered(
                bank, frames, intervals, paths, first_is_updated, rejects_outliers)
            smoothed = np.stack(smoothed_states(steps), axis=1)
            variance = np.array([np.einsum('pii->p', step.P[:, :3, :3]) for step in steps]).T
            log_likelihood[~(variance >= 0.0).all(axis=1)] = -np.inf
            std = np.sqrt(np.where(variance >= 0.0, variance, np.nan))
            shift = np.linalg.norm((smoothed - paths)[:, :, :3], axis=2) / std
            new = np.isnan(paths)
            paths += step * (smoothed - paths)
            paths[new] = smoothed[new]
        covariances = np.stack(smoothed_covariances(steps), axis=1) if wants_covariances \
            else np.empty(0)
        return PathResult(log_likelihood, shift.max(axis=1), used, covariances)

    def filtered(self, bank, frames, intervals, paths, first_is_updated, rejects_outliers):
        """Filter all frames once; return (`Step`s, log-likelihood, whether each frame was used)."""
        steps, total = [], np.zeros(len(bank))
        used = np.ones((len(bank), len(frames)), dtype=bool)
        for k, (frame, dt) in enumerate(zip(frames, intervals, strict=True)):
            previous, current = (None if np.isnan(path).any() else path
                                 for path in (paths[:, k - 1], paths[:, k]))
            F, decay = self.predict(bank, dt, previous) if k else (None, None)
            gains = None
            if k == 0 and first_is_updated:
                used[:, k] = False
            else:
                prior = bank.x.copy(), bank.P.copy()
                of_frame, gains = self.update(bank, frame, dt, current)
                if rejects_outliers and self.is_implausible(bank, 0, frame):
                    bank.x, bank.P = prior
                    gains, used[:, k] = None, False
                else:
                    total = total + of_frame
            steps.append(Step(bank.x.copy(), bank.P.copy(), gains, F, decay))
        return steps, total, used


class PlainFilter(StepByStep, BankFilter):
    """`BankFilter` with separate steps in NumPy, each for the whole bank."""

    def __init__(self, network, model, settings, n_targets=1):
        super().__init__(network, model, settings, n_targets)
        self.model = model

    def _propagate(self, x, dt, P):
        """Propagate all targets, one after the other."""
        n, n_one = self.observation.n_target, self.observation.n_one
        moved, F, Q = np.empty_like(x), np.zeros((len(x), n, n)), np.zeros((len(x), n, n))
        for first in range(0, n, n_one):
            own = slice(first, first + n_one)
            moved[:, own], F[:, own, own], Q[:, own, own] = predicted(
                self.model, x[:, own], dt, P[:, own, own])
        return moved, F, Q

    def predict(self, bank, dt, x_lin=None):
        """Time update in place; return (Jacobian, decay).

        The update is linearised at `x_lin`, or at the states of the bank if `x_lin` is None.
        """
        n_t = self.observation.n_target
        x_start = (bank.x if x_lin is None else x_lin)[:, :n_t]
        x_target, F, Q = self._propagate(x_start, dt, bank.P[:, :n_t, :n_t])
        if x_lin is not None:
            x_target = x_target + (F @ (bank.x[:, :n_t] - x_start)[:, :, None])[:, :, 0]
        decay, variance = (v[0] for v in self.observation.drift(
            np.array([dt]), self._settings.background_drift))
        plain_kalman.predict(bank.x, bank.P, x_target, F, Q if dt > 0.0 else 0.0 * Q, variance,
                             decay)
        return F, decay

    def update(self, bank, frame, dt, x_lin=None):
        """Measurement update in place; return (log-likelihood, `Gains`).

        The update is linearised at `x_lin`, or iterated if `x_lin` is None.
        """
        iterations = self._settings.iterations if x_lin is None else 1
        covariance = np.where(np.isnan(frame.covariance), np.eye(3), frame.covariance)
        x_prior, P_prior = bank.x, bank.P
        x_lin = bank.x.copy() if x_lin is None else x_lin
        for _ in range(iterations):
            bank.x, bank.P = x_prior.copy(), P_prior.copy()
            h, H, inflation = self.observation.fields(
                x_lin, self.time_offset(frame, dt), self._lengths(bank.kind),
                self._settings.field_error)
            invalid = ~(np.isfinite(h).all(axis=(1, 2)) & np.isfinite(H).all(axis=(1, 2, 3)))
            h[invalid], H[invalid], inflation[invalid] = 0.0, 0.0, 0.0
            log_likelihood, bank.nis, gains = plain_kalman.update(
                bank.x, bank.P, frame.field, h, H, covariance, inflation, x_lin,
                self.observation.n_own)
            log_likelihood[invalid] = -np.inf
            x_lin = bank.x.copy()
        bank.nis[:, np.isnan(frame.field).all(axis=1)] = np.nan
        return log_likelihood, gains

    def move(self, bank, dt):
        bank.x, bank.P = bank.x.copy(), bank.P.copy()
        self.predict(bank, dt)

    def advance(self, bank, frame, dt):
        bank.x, bank.P = bank.x.copy(), bank.P.copy()
        if dt > 0.0:
            self.predict(bank, dt)
        predicted = bank.x.copy()
        return predicted, self.update(bank, frame, dt)[0]
