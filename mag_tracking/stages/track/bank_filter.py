"""Prediction and update of a bank: where the target's physics meets the filter."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference import kalman
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.time_update import predict
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import SourceModel
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.unseen_length import CAR_ROW

LINEAR = 0.25
"""A field is about linear in the position over this share of the distance to the nearest sensor:
the cube of that distance changes by a factor of two."""

ONE_TIME = 0.05
"""A frame that is shorter than this share of the time since the frame before is one time, and so
is the first of a track: velocities are better learnt from frame to frame than within one."""


class BankFilter:
    """Moves a `FilterBank` through frames; has no memory of its own."""

    def __init__(self, network: SensorNetwork, model: SourceModel,
                 settings: TrackSettings) -> None:
        """`settings` is a `TrackSettings`; the live ones may be changed by `configure`."""
        self._n_sensors = len(network)
        self._model = model
        self.observation = Observation(network, model, np.deg2rad(settings.mounting_std_deg),
                                       settings.model_error_time_s)
        self.configure(settings)

    def configure(self, settings: TrackSettings) -> None:
        """Take new values of the live settings."""
        self._settings = settings
        is_vehicle = settings.target == 'vehicle'
        self._near_field_lengths: FloatArray = np.atleast_1d(
            settings.vehicle.near_field_lengths if is_vehicle
            else settings.magnet.near_field_length)
        self._are_long: BoolArray = np.array(
            settings.vehicle.lengths if is_vehicle else [0.0]) > CAR_ROW

    def predict(self, bank: FilterBank, dt: float, x_lin: FloatArray | None = None
                ) -> tuple[FloatArray, FloatArray]:
        """Time update in place; backwards in time without process noise.

        It is linearised at `x_lin` (n_hyp, n_x), states before it, or at those of the bank.

        Returns
        -------
        F : (n_hyp, n_t, n_t) or (n_t, n_t)
            Jacobian of the target's motion.
        decay : (n_x - n_t,)
            What the other states were multiplied by.
        """
        n_t = self.observation.n_target
        at = (bank.x if x_lin is None else x_lin)[:, :n_t]
        x_target, F, Q = self._model.propagate(at, dt, bank.P[:, :n_t, :n_t])
        if x_lin is not None:
            x_target = x_target + (F @ (bank.x[:, :n_t] - at)[:, :, None])[:, :, 0]
        decay, variance = self.observation.drift(dt, self._settings.background_drift)
        predict(bank.x, bank.P, x_target, F, Q if dt > 0.0 else 0.0 * Q, variance, decay)
        return F, decay

    def fields(self, x: FloatArray, kind: IntArray, frame: FieldFrame, dt: float
               ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fields of the states `x` (n_hyp, n_x) of the kinds `kind`; see `Observation.fields`.

        `dt` [s] since the frame before says whether the frame is one time.
        """
        one_time = dt <= 0.0 or np.ptp(frame.time_offset) < ONE_TIME * dt
        offset = np.zeros(self._n_sensors) if one_time else frame.time_offset
        return self.observation.fields(x, offset, self._near_field_lengths[kind],
                                       self._settings.field_error)

    def model_error(self, bank: FilterBank, i: int, dt: float) -> FloatArray:
        """(n_sensors,) [T^2] variance of what the model of hypothesis `i` leaves out of a field.

        Only of what is new after `dt` [s].
        """
        error = self.observation.model_error(
            bank.x[i], float(self._near_field_lengths[bank.kind[i]]), self._settings.field_error)
        time = self._settings.model_error_time_s
        share = -np.expm1(-2.0 * dt / time) if time else 1.0
        return share * np.nan_to_num(error, posinf=0.0)

    def predicted_field(self, bank: FilterBank, i: int, frame: FieldFrame,
                        dt: float) -> FloatArray:
        """(n_sensors, 3) [T] the field of the frame as hypothesis `i` has it, with backgrounds.

        Without what it takes for errors of its model: with them anything would seem to fit.
        """
        x = self.observation.without_errors(bank.x[i:i + 1])
        h, _, _ = self.fields(x, bank.kind[i:i + 1], frame, dt)
        field: FloatArray = h[0] + x[0, -3 * self._n_sensors:].reshape(-1, 3)
        return field

    def update(self, bank: FilterBank, frame: FieldFrame, dt: float,
               x_lin: FloatArray | None = None) -> FloatArray:
        """Measurement update in place; the arrays that `bank.x` and `bank.P` were stay as they are.

        It is linearised at `x_lin` (n_hyp, n_x), or if that is left out at the prediction and
        then again as often as the settings say. Returns the log-likelihood (n_hyp,) of the frame.
        """
        return self._update(bank, frame, dt, x_lin)[0]

    def update_with_gains(self, bank: FilterBank, frame: FieldFrame, dt: float,
                          x_lin: FloatArray | None = None) -> tuple[FloatArray, kalman.Gains]:
        """The same, for a backward pass: (log-likelihood (n_hyp,), `kalman.Gains`)."""
        log_likelihood, gains = self._update(bank, frame, dt, x_lin, wants_gains=True)
        assert gains is not None
        return log_likelihood, gains

    def _update(self, bank: FilterBank, frame: FieldFrame, dt: float, x_lin: FloatArray | None,
                wants_gains: bool = False) -> tuple[FloatArray, kalman.Gains | None]:
        """Log-likelihood (n_hyp,), and the `kalman.Gains` or None."""
        covariance = known_covariance(frame)
        x_prior, P_prior = bank.x, bank.P
        iterations = self._settings.iterations if x_lin is None else 1
        x_lin = bank.x.copy() if x_lin is None else x_lin
        for _ in range(iterations):
            bank.x, bank.P = x_prior.copy(), P_prior.copy()
            h, H, inflation = self.fields(x_lin, bank.kind, frame, dt)
            # A dipole on a sensor has no field: such a hypothesis is as good as ruled out.
            lost = ~(np.isfinite(h).all(axis=(1, 2)) & np.isfinite(H).all(axis=(1, 2, 3))
                     & np.isfinite(inflation).all(axis=1))
            h[lost], H[lost], inflation[lost] = 0.0, 0.0, 0.0
            gains = kalman.Gains.of(H, self.observation.n_own, bank.x.shape[1]) \
                if wants_gains else None
            log_likelihood, bank.nis = kalman.update(
                bank.x, bank.P, frame.field, h, H, covariance, inflation, x_lin,
                self.observation.n_own, gains)
            log_likelihood[lost] = -np.inf
            x_lin = bank.x.copy()
        bank.nis[:, np.isnan(frame.field).all(axis=1)] = np.nan
        return log_likelihood, gains

    def are_long(self, kind: IntArray) -> BoolArray:
        """(n,) whether targets of the kinds `kind` (n,) are longer than a car."""
        return self._are_long[kind]

    def nearly_linear(self, x: FloatArray) -> FloatArray:
        """(n_hyp,) [m] how far the position of the states `x` (n_hyp, n_x) may be off for the field
        to be about linear in it."""
        return LINEAR * self.observation.nearest(x)

    def is_strange(self, bank: FilterBank, i: int, frame: FieldFrame) -> bool:
        """Whether hypothesis `i`, just updated with the `frame`, is contradicted by it."""
        n_y = np.count_nonzero(~np.isnan(frame.field))
        return bool(np.nansum(bank.nis[i]) > self._settings.end_nis * n_y)


class NoTarget:
    """The filter of no target at all, only backgrounds that wander: what evidence is against."""

    def __init__(self, n_sensors: int, background_std: float) -> None:
        self._x = np.zeros((1, 3 * n_sensors))
        self._P = background_std**2 * np.eye(3 * n_sensors)[None]

    def log_density(self, frame: FieldFrame, dt: float, background_drift: float) -> float:
        """Log-density of the frame given those before; `dt` [s] since the last one."""
        n = len(frame.field)
        i = np.arange(3 * n)
        self._P[0, i, i] += background_drift**2 * dt
        log_likelihood, _ = kalman.update(
            self._x, self._P, frame.field, np.zeros((1, n, 3)), np.zeros((1, n, 3, 0)),
            known_covariance(frame), np.zeros((1, n)))
        return float(log_likelihood[0])


def known_covariance(frame: FieldFrame) -> FloatArray:
    """(n_sensors, 3, 3) [T^2]; identity where an axis is missing."""
    return np.where(np.isnan(frame.covariance), np.eye(3), frame.covariance)

