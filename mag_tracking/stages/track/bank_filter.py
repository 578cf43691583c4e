"""Prediction and update of a `FilterBank` with the motion and field model of the target."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import Magnet, SourceModel
from mag_tracking.physics.vehicles import MAX_TURN_RATE, RowVehicle
from mag_tracking.records import FieldFrame, plain
from mag_tracking.stages.track import core
from mag_tracking.stages.track.initiation_magnet import NEAR_FIELD_LENGTH
from mag_tracking.stages.track.initiation_vehicle import MAX_CAR_ROW
from mag_tracking.stages.track.observation import TIME_RESOLUTION_S, Observation
from mag_tracking.stages.track.settings import TrackSettings

LINEAR_FRACTION, SAME_TIME_FRACTION = 0.25, 0.05
"""Relative displacement over which the field, inverse to the cube of the distance, is about linear,
and fraction of the interval between frames in which samples are simultaneous."""
NEGLIGIBLE_ENERGY, WEAK_ENERGY = 0.1, 1.0
"""Whitened squared field per frame below which a departing target is removed from a joint track,
and up to which it does not disturb others: the limit if there are no more places."""
DETECTABLE_ENERGY = 4.0
"""Minimum squared norm of the whitened field of a detectable target: in the last frame, of a new
vehicle in a window at each sensor, and of a path according to the prior of its moments."""


class PathResult(NamedTuple):
    """Result of `BankFilter.run_along`; the first axis of every array is the hypothesis."""

    log_likelihood: FloatArray
    """(n_hyp,) Log-likelihood of the used frames; -inf if the path is unusable."""
    max_shift: FloatArray
    """(n_hyp,) Largest shift of the positions in the last pass, in their stds."""
    used: BoolArray
    """Whether the hypothesis was updated with each frame, (n_hyp, n)."""
    covariances: FloatArray
    """Smoothed covariance at each frame, (n_hyp, n, n_x, n_x); empty if not requested."""


def compiled_filter(model: SourceModel, observation: Observation
                    ) -> core.RowVehicleFilter | core.VehiclesFilter | core.MagnetFilter:
    """Compiled filter for a source model and its observation model."""
    sensors = (observation.positions, observation.R_sw, observation.n_angles,
               observation.n_own - observation.n_angles)
    if isinstance(model, RowVehicle):
        create = partial(core.RowVehicleFilter, *sensors) if observation.n_targets == 1 \
            else partial(core.VehiclesFilter, *sensors, observation.n_targets)
        return create(len(model.state_names), model.n_dipoles, list(model.acceleration_density),
                      list(model.field_strength), model.moment_drift, model.difference_drift,
                      model.turn_acceleration, model.turn_time, MAX_TURN_RATE)
    assert isinstance(model, Magnet) and observation.n_targets == 1
    return core.MagnetFilter(*sensors, list(model.acceleration_density), model.angular_density)


class BankFilter:
    """Stateless filter of a `FilterBank` of `n_targets` targets whose fields add up."""

    def __init__(self, network: SensorNetwork, model: SourceModel, settings: TrackSettings,
                 n_targets: int = 1) -> None:
        self._n_sensors = len(network)
        self._zero_offset = np.zeros(len(network))
        self.observation = Observation(network, model, np.deg2rad(settings.mounting_std_deg),
                                       settings.model_error_time_s, n_targets)
        self._compiled = compiled_filter(model, self.observation)
        self._settings = settings
        is_vehicle = settings.target == 'vehicle'
        self._near_field_lengths: FloatArray = np.array(
            [kind.near_field_length for kind in settings.vehicle.kinds] if is_vehicle
            else [NEAR_FIELD_LENGTH])
        self._is_long_kind: BoolArray = np.array(
            [kind.length for kind in settings.vehicle.kinds] if is_vehicle else [0.0]) > MAX_CAR_ROW

    def move(self, bank: FilterBank, dt: float) -> None:
        """Predict a bank in place by `dt` seconds; negative values add no process noise."""
        n = self._n_sensors
        empty_frame = FieldFrame(0, np.full((n, 3), np.nan), np.tile(np.eye(3), (n, 1, 1)),
                                 np.zeros(n, dtype=np.int64), np.zeros(n))
        self._advance(bank, empty_frame, dt, True, 0)

    def advance(self, bank: FilterBank, frame: FieldFrame, dt: float, keeps_prior: bool = False
                ) -> tuple[FloatArray, FloatArray]:
        """Predict a bank in place to the time of a frame, if `dt` [s] is positive, and update it;
        return the predicted states (n_hyp, n_x) and the log-likelihoods (n_hyp,), -inf if a dipole
        is at a sensor; with `keeps_prior`, slower, new arrays replace `bank.x` and `bank.P`."""
        return self._advance(bank, frame, dt, dt > 0.0, self._settings.iterations, keeps_prior)

    def _advance(self, bank: FilterBank, frame: FieldFrame, dt: float, moves: bool,
                 iterations: int, keeps_prior: bool = False) -> tuple[FloatArray, FloatArray]:
        """Advance a bank; skip the prediction unless `moves`, and the update with 0 iterations."""
        n_hyp = len(bank)
        decay, variance = self.observation.drift(np.asarray(dt), self._settings.background_drift)
        # With a thousand hypotheses the speed is limited by memory: writing to new arrays takes
        # twice as long.
        new_x, new_P = (np.empty_like(a) if keeps_prior else a for a in (bank.x, bank.P))
        predicted = np.empty_like(bank.x)
        log_likelihood, nis = np.zeros(n_hyp), np.full((n_hyp, self._n_sensors), np.nan)
        # Positional arguments: parsing this many keywords costs as much as a few hypotheses.
        self._compiled.advance(
            plain(frame.field), plain(known_covariance(frame.covariance)),
            self.time_offset(frame, dt), dt, decay, variance, moves, iterations,
            self._settings.field_error, self._lengths(bank.kind), bank.x, bank.P, new_x, new_P,
            predicted, log_likelihood, nis)
        bank.x, bank.P, bank.nis = new_x, new_P, nis
        return predicted, log_likelihood

    def run_along(self, bank: FilterBank, frames: Sequence[FieldFrame],
                  intervals: Sequence[float], paths: FloatArray, *, passes: int, step: float,
                  first_is_updated: bool, rejects_outliers: bool = False,
                  wants_covariances: bool = False) -> PathResult:
        """Filter and smooth each hypothesis along its path, and each pass along the path of the
        previous one; the bank moves in place from the first to the last of the n frames.

        Parameters
        ----------
        intervals : time from the previous frame to each frame, s
        paths : (n_hyp, n, n_x) array, linearisation points, updated in place; at NaN, a frame is
            linearised at its prediction, with the iterations of `advance`
        step : fraction of the difference between smoothed states and path by which each pass moves
            the path
        first_is_updated : whether the bank has already been updated with the first frame
        rejects_outliers : whether frames whose normalised innovation squared exceeds `end_nis` per
            axis are not used for updates
        """
        n_hyp, n, n_x = paths.shape
        out = PathResult(np.empty(n_hyp), np.empty(n_hyp), np.empty((n_hyp, n), dtype=bool),
                         np.empty((n_hyp, n, n_x, n_x) if wants_covariances else 0))
        new_x, new_P = np.empty_like(bank.x), np.empty_like(bank.P)
        dt = np.array(intervals, dtype=float)
        decay, variance = self.observation.drift(dt, self._settings.background_drift)
        self._compiled.run_along(
            field=np.array([frame.field for frame in frames]),
            covariance=known_covariance(np.array([f.covariance for f in frames])),
            offset=np.array([self.time_offset(f, t)
                             for f, t in zip(frames, intervals, strict=True)]),
            dt=dt, decay=decay, variance=variance, first_is_updated=first_is_updated,
            max_nis=self._settings.end_nis if rejects_outliers else np.inf,
            iterations=self._settings.iterations, passes=passes, step=step,
            field_error=self._settings.field_error,
            near_field_length=self._lengths(bank.kind), x=bank.x, P=bank.P,
            new_x=new_x, new_P=new_P, paths=paths, log_likelihood=out.log_likelihood,
            max_shift=out.max_shift, covariances=out.covariances, used=out.used)
        bank.x, bank.P = new_x, new_P
        return out

    def time_offset(self, frame: FieldFrame, dt: float) -> FloatArray:
        """Sampling time (n_sensors,) of each sensor in a frame, s; 0 if simultaneous."""
        offset: FloatArray = frame.time_offset
        if dt <= 0.0 or offset.max() - offset.min() < SAME_TIME_FRACTION * dt:
            return self._zero_offset
        return np.round(offset / TIME_RESOLUTION_S) * TIME_RESOLUTION_S

    def model_error(self, bank: FilterBank, i: int, dt: float) -> FloatArray:
        """Variance (n_sensors,) per axis of the part of the model error in the field of hypothesis
        `i` that is uncorrelated with the previous frame, T²; 0 where a dipole is at the sensor."""
        error = self.observation.model_error(
            bank.x[i], self._lengths(bank.kind[i:i + 1])[0], self._settings.field_error)
        time = self._settings.model_error_time_s
        fraction = -np.expm1(-2.0 * dt / time) if time else 1.0
        return fraction * np.nan_to_num(error, posinf=0.0)

    def predicted_field(self, bank: FilterBank, i: int, frame: FieldFrame,
                        dt: float) -> FloatArray:
        """Field (n_sensors, 3) that hypothesis `i` predicts for a frame, T, sensor frame, with
        backgrounds, but without model errors, with which almost any field would fit."""
        h, _ = self.fields_at(bank.x[i], bank.kind[i:i + 1], frame, dt)
        return h + bank.x[i, -3 * self._n_sensors:].reshape(-1, 3)

    def fields_at(self, x: FloatArray, kind: IntArray, frame: FieldFrame, dt: float
                  ) -> tuple[FloatArray, FloatArray]:
        """Fields (n_sensors, 3) [T] of the targets of a state `x` (n_x,) with kinds (1,) or (1,
        n_targets) in a frame, without backgrounds and model errors, and their derivatives."""
        without_errors = x[None].copy()
        self.observation.own(without_errors)[..., self.observation.n_angles:] = 0.0
        h, H, _ = self.observation.fields(without_errors, self.time_offset(frame, dt),
                                          self._lengths(kind), self._settings.field_error)
        return h[0], H[0, :, :, :self.observation.n_target]

    def field_of_others(self, bank: FilterBank, i: int, target: int, frame: FieldFrame,
                        dt: float) -> FloatArray:
        """Field (n_sensors, 3) [T] of all targets of a hypothesis except `target`."""
        others = [k for k in range(self.observation.n_targets) if k != target]
        return self.observation.field_of(bank.x[i], others, self.time_offset(frame, dt))

    def field_energies(self, target: int, x: FloatArray, frame: FieldFrame) -> FloatArray:
        """Squared norm (n_sensors,) of the whitened field of one target of a state."""
        field = self.observation.field_of(x, [target], self._zero_offset)
        return whitened_energy(np.where(np.isnan(frame.field), np.nan, field), frame.covariance)[0]

    def _lengths(self, kind: IntArray) -> FloatArray:
        """Near-field length (n, n_targets) [m] of each target, from its kind."""
        return self._near_field_lengths[kind].reshape(len(kind), -1)

    def are_long(self, kind: IntArray) -> BoolArray:
        """Whether any target of each hypothesis, of a given kind, is longer than a car."""
        are_long: BoolArray = np.any(self._is_long_kind[kind].reshape(len(kind), -1), axis=1)
        return are_long

    def linear_range(self, x: FloatArray) -> FloatArray:
        """Displacement (n_hyp,) over which the field is approximately linear, m."""
        return LINEAR_FRACTION * self.observation.distance_to_nearest(x)

    def is_implausible(self, bank: FilterBank, i: int, frame: FieldFrame) -> bool:
        """Whether the innovation of a hypothesis exceeds `end_nis` per axis."""
        n_y = np.count_nonzero(~np.isnan(frame.field))
        return bool(np.nansum(bank.nis[i]) > self._settings.end_nis * n_y)


class NoTarget:
    """Filter of the backgrounds without a target, with an initial std `background_std` [T]."""

    def __init__(self, n_sensors: int, background_std: float) -> None:
        self._x = np.zeros((n_sensors, 3))
        self._P = np.tile(background_std**2 * np.eye(3), (n_sensors, 1, 1))

    def log_density(self, frame: FieldFrame, dt: float, background_drift: float) -> float:
        """Update the backgrounds with a frame; return its log-density given the others."""
        self._P += background_drift**2 * dt * np.eye(3)
        is_present = ~np.isnan(frame.field)
        both_present = is_present[:, :, None] & is_present[:, None, :]
        # A missing axis has zero innovation and an independent unit variance.
        u = np.where(is_present, frame.field - self._x, 0.0)
        S = np.where(both_present, self._P + frame.covariance, np.eye(3))
        L = np.linalg.cholesky(S)
        whitened = np.linalg.solve(L, np.concatenate(
            [u[:, :, None], np.where(is_present[:, :, None], self._P, 0.0)], axis=2))
        z, G = whitened[:, :, 0], whitened[:, :, 1:]
        self._x += np.einsum('jai,ja->ji', G, z)
        self._P -= np.swapaxes(G, 1, 2) @ G
        return float(-0.5 * (np.square(z).sum()
                             + np.count_nonzero(is_present) * np.log(2.0 * np.pi))
                     - np.log(np.einsum('jaa->ja', L)).sum())


def known_covariance(covariance: FloatArray) -> FloatArray:
    """Covariances (..., 3, 3) in which elements of the identity replace the NaN of missing axes."""
    missing = np.isnan(covariance)
    return np.where(missing, np.eye(3), covariance) if missing.any() else covariance
