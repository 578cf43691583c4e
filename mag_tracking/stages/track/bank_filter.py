"""Prediction and update of a bank: where the target's physics meets the filter."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import Magnet, SourceModel
from mag_tracking.physics.vehicles import FASTEST_TURN, RowVehicle
from mag_tracking.records import FieldFrame, plain
from mag_tracking.stages.track import core
from mag_tracking.stages.track.observation import TIME_RESOLUTION_S, Observation
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.unobserved_length import MAX_CAR_ROW

LINEAR = 0.25
"""A field is about linear in the position over this share of the distance to the nearest sensor:
the cube of that distance changes by a factor of two."""

ONE_TIME = 0.05
"""A frame that is shorter than this share of the time since the frame before is one time, and so
is the first of a track: velocities are better learnt from frame to frame than within one."""


class Along(NamedTuple):
    """What came of `BankFilter.run_along`, for each hypothesis."""

    log_likelihood: FloatArray
    """(n_hyp,) of all frames along the path; -inf where it is of no use."""
    unsettled: FloatArray
    """(n_hyp,) how far the last pass moved a path at most, in deviations of its position."""
    used: BoolArray
    """(n_hyp, n) whether it was updated with a frame."""
    covariances: FloatArray
    """(n_hyp, n, n_x, n_x) at each frame given all of them; empty where nobody wants them."""


def compiled_filter(model: SourceModel, observation: Observation
                    ) -> core.RowVehicleFilter | core.VehiclesFilter | core.MagnetFilter:
    """The compiled filter of targets that are seen as `observation` says."""
    sensors = (observation.positions, observation.R_sw, observation.n_angles,
               observation.n_own - observation.n_angles)
    if isinstance(model, RowVehicle):
        one = partial(core.RowVehicleFilter, *sensors) if observation.n_targets == 1 \
            else partial(core.VehiclesFilter, *sensors, observation.n_targets)
        return one(len(model.state_names), model.n_dipoles, list(model.acceleration_density),
                   list(model.induction), model.moment_drift, model.difference_drift,
                   model.turn_acceleration, model.turn_time, FASTEST_TURN)
    assert isinstance(model, Magnet) and observation.n_targets == 1
    return core.MagnetFilter(*sensors, list(model.acceleration_density), model.angular_density)


class BankFilter:
    """Moves a `FilterBank` through frames; has no memory of its own."""

    def __init__(self, network: SensorNetwork, model: SourceModel, settings: TrackSettings,
                 n_targets: int = 1) -> None:
        """`settings` is a `TrackSettings`; the live ones may be changed by `configure`. The states
        are those of `n_targets` targets whose fields add up."""
        self._n_sensors = len(network)
        self._no_offset = np.zeros(len(network))
        self.observation = Observation(network, model, np.deg2rad(settings.mounting_std_deg),
                                       settings.model_error_time_s, n_targets)
        self._compiled = compiled_filter(model, self.observation)
        self.configure(settings)

    def configure(self, settings: TrackSettings) -> None:
        """Take new values of the live settings."""
        self._settings = settings
        is_vehicle = settings.target == 'vehicle'
        self._near_field_lengths: FloatArray = np.atleast_1d(
            settings.vehicle.near_field_lengths if is_vehicle
            else settings.magnet.near_field_length).astype(float)
        self._are_long: BoolArray = np.array(
            settings.vehicle.lengths if is_vehicle else [0.0]) > MAX_CAR_ROW

    def move(self, bank: FilterBank, dt: float) -> None:
        """Time update over `dt` [s]; backwards in time without process noise."""
        n = self._n_sensors
        nowhere = FieldFrame(0, np.full((n, 3), np.nan), np.tile(np.eye(3), (n, 1, 1)),
                             np.zeros(n, dtype=np.int64), np.zeros(n))
        self._advance(bank, nowhere, dt, True, 0)

    def advance(self, bank: FilterBank, frame: FieldFrame, dt: float, keeps_prior: bool = False
                ) -> tuple[FloatArray, FloatArray]:
        """Time update to a frame that comes `dt` [s] after the one before, and update with it.

        The update is linearised as often as the settings say. With `keeps_prior` the arrays that
        `bank.x` and `bank.P` were stay as they are, which takes longer; else they are written into.

        Returns
        -------
        predicted : (n_hyp, n_x)
            The states before the update.
        log_likelihood : (n_hyp,)
            Of the frame; -inf where a dipole sits on a sensor.
        """
        return self._advance(bank, frame, dt, dt > 0.0, self._settings.iterations, keeps_prior)

    def _advance(self, bank: FilterBank, frame: FieldFrame, dt: float, moves: bool,
                 iterations: int, keeps_prior: bool = False) -> tuple[FloatArray, FloatArray]:
        """(predicted (n_hyp, n_x), log-likelihood (n_hyp,)); without iterations it only moves."""
        n_hyp = len(bank)
        decay, variance = self.observation.drift(np.asarray(dt), self._settings.background_drift)
        # Memory limits the speed with a thousand hypotheses: writing to new arrays takes twice as
        # long.
        new_x, new_P = (np.empty_like(a) if keeps_prior else a for a in (bank.x, bank.P))
        predicted = np.empty_like(bank.x)
        log_likelihood, nis = np.zeros(n_hyp), np.full((n_hyp, self._n_sensors), np.nan)
        # By position: names of so many arguments would take as long as a few hypotheses.
        self._compiled.advance(
            plain(frame.field), plain(known_covariance(frame.covariance)),
            self.time_offset(frame, dt), dt, decay, variance, moves, iterations,
            self._settings.field_error, self._lengths(bank.kind), bank.x, bank.P, new_x, new_P,
            predicted, log_likelihood, nis)
        bank.x, bank.P, bank.nis = new_x, new_P, nis
        return predicted, log_likelihood

    def run_along(self, bank: FilterBank, frames: Sequence[FieldFrame],
                  intervals: Sequence[float], paths: FloatArray, *, passes: int, step: float,
                  first_is_updated: bool, leaves_out: bool = False,
                  wants_covariances: bool = False) -> Along:
        """Filter and smooth each hypothesis along its path, and end with the last frame.

        Parameters
        ----------
        bank : FilterBank
            At the first frame; `bank.x` and `bank.P` are replaced by those at the last one.
        frames : list of n FieldFrame
        intervals : list of n float [s]
            Time from the frame before.
        paths : (n_hyp, n, n_x)
            Where they are linearised; NaN: at the predictions, iterated as `advance` does. Moved,
            in place.
        passes : int
            How often it is done; each time it is linearised where the time before led.
        step : float
            The share of the way that a path is moved to where the smoother has it.
        first_is_updated : bool
            The bank has been updated with the first frame.
        leaves_out : bool
            Frames that contradict a hypothesis are left out.
        wants_covariances : bool
        """
        n_hyp, n, n_x = paths.shape
        out = Along(np.empty(n_hyp), np.empty(n_hyp), np.empty((n_hyp, n), dtype=bool),
                    np.empty((n_hyp, n, n_x, n_x) if wants_covariances else 0))
        new_x, new_P = np.empty_like(bank.x), np.empty_like(bank.P)
        self._compiled.run_along(
            **self._frames(frames, intervals), first_is_updated=first_is_updated,
            strange=self._settings.end_nis if leaves_out else np.inf,
            iterations=self._settings.iterations, passes=passes, step=step,
            field_error=self._settings.field_error,
            near_field_length=self._lengths(bank.kind), x=bank.x, P=bank.P,
            new_x=new_x, new_P=new_P, paths=paths, log_likelihood=out.log_likelihood,
            unsettled=out.unsettled, covariances=out.covariances, used=out.used)
        bank.x, bank.P = new_x, new_P
        return out

    def _frames(self, frames: Sequence[FieldFrame], intervals: Sequence[float]
                ) -> dict[str, FloatArray]:
        """Frames as compiled code takes them, one after the other."""
        dt = np.array(intervals, dtype=float)
        decay, variance = self.observation.drift(dt, self._settings.background_drift)
        return {'field': np.array([frame.field for frame in frames]),
                'covariance': known_covariance(np.array([f.covariance for f in frames])),
                'offset': np.array([self.time_offset(f, t)
                                    for f, t in zip(frames, intervals, strict=True)]),
                'dt': dt, 'decay': decay, 'variance': variance}

    def time_offset(self, frame: FieldFrame, dt: float) -> FloatArray:
        """(n_sensors,) [s] of the samples of a frame that comes `dt` [s] after the one before."""
        offset: FloatArray = frame.time_offset
        if dt <= 0.0 or offset.max() - offset.min() < ONE_TIME * dt:
            return self._no_offset
        return np.round(offset / TIME_RESOLUTION_S) * TIME_RESOLUTION_S

    def model_error(self, bank: FilterBank, i: int, dt: float) -> FloatArray:
        """(n_sensors,) [T^2] variance of what the model of hypothesis `i` leaves out of a field.

        Only of what is new after `dt` [s].
        """
        error = self.observation.model_error(
            bank.x[i], self._lengths(bank.kind[i:i + 1])[0], self._settings.field_error)
        time = self._settings.model_error_time_s
        share = -np.expm1(-2.0 * dt / time) if time else 1.0
        return share * np.nan_to_num(error, posinf=0.0)

    def predicted_field(self, bank: FilterBank, i: int, frame: FieldFrame,
                        dt: float) -> FloatArray:
        """(n_sensors, 3) [T] the field of the frame as hypothesis `i` has it, with backgrounds.

        Without what it takes for errors of its model: with them anything would seem to fit.
        """
        x = self.observation.without_errors(bank.x[i:i + 1])
        h, _, _ = self.observation.fields(
            x, self.time_offset(frame, dt), self._lengths(bank.kind[i:i + 1]),
            self._settings.field_error)
        field: FloatArray = h[0] + x[0, -3 * self._n_sensors:].reshape(-1, 3)
        return field

    def fields_at(self, x: FloatArray, kind: IntArray, frame: FieldFrame, dt: float
                  ) -> tuple[FloatArray, FloatArray]:
        """The fields (n_sensors, 3) [T] of the targets of a state (n_x,), without backgrounds and
        errors, at the times of a frame; and their derivative (n_sensors, 3, n_target).

        `kind` (1,) or (1, n_targets).
        """
        h, H, _ = self.observation.fields(
            self.observation.without_errors(x[None]), self.time_offset(frame, dt),
            self._lengths(kind), self._settings.field_error)
        return h[0], H[0, :, :, :self.observation.n_target]

    def field_of_others(self, bank: FilterBank, i: int, target: int, frame: FieldFrame,
                        dt: float) -> FloatArray:
        """(n_sensors, 3) [T] the field of a frame that hypothesis `i` has of all but one target."""
        others = [k for k in range(self.observation.n_targets) if k != target]
        return self.observation.field_of(bank.x[i], others, self.time_offset(frame, dt))

    def _lengths(self, kind: IntArray) -> FloatArray:
        """(n, n_targets) [m] near-field lengths of the kinds `kind` (n,) or (n, n_targets)."""
        return self._near_field_lengths[kind].reshape(len(kind), -1)

    def are_long(self, kind: IntArray) -> BoolArray:
        """(n,) whether any target of the kinds `kind` (n,) or (n, n_targets) is longer than a car.
        """
        are_long: BoolArray = np.any(self._are_long[kind].reshape(len(kind), -1), axis=1)
        return are_long

    def nearly_linear(self, x: FloatArray) -> FloatArray:
        """(n_hyp,) [m] how far the position of the states `x` (n_hyp, n_x) may be off for the field
        to be about linear in it."""
        return LINEAR * self.observation.distance_to_nearest(x)

    def is_implausible(self, bank: FilterBank, i: int, frame: FieldFrame) -> bool:
        """Whether hypothesis `i`, just updated with the `frame`, is contradicted by it."""
        n_y = np.count_nonzero(~np.isnan(frame.field))
        return bool(np.nansum(bank.nis[i]) > self._settings.end_nis * n_y)


class NoTarget:
    """The filter of no target at all, only backgrounds that wander: what evidence is against."""

    def __init__(self, n_sensors: int, background_std: float) -> None:
        self._x = np.zeros((n_sensors, 3))
        self._P = np.tile(background_std**2 * np.eye(3), (n_sensors, 1, 1))

    def log_density(self, frame: FieldFrame, dt: float, background_drift: float) -> float:
        """Log-density of the frame given those before; `dt` [s] since the last one."""
        self._P += background_drift**2 * dt * np.eye(3)
        there = ~np.isnan(frame.field)
        both = there[:, :, None] & there[:, None, :]
        # An axis that is missing has no innovation, and a variance of its own.
        u = np.where(there, frame.field - self._x, 0.0)
        S = np.where(both, self._P + frame.covariance, np.eye(3))
        L = np.linalg.cholesky(S)
        whitened = np.linalg.solve(L, np.concatenate(
            [u[:, :, None], np.where(there[:, :, None], self._P, 0.0)], axis=2))
        z, G = whitened[:, :, 0], whitened[:, :, 1:]
        self._x += np.einsum('jai,ja->ji', G, z)
        self._P -= np.swapaxes(G, 1, 2) @ G
        return float(-0.5 * (np.square(z).sum() + np.count_nonzero(there) * np.log(2.0 * np.pi))
                     - np.log(np.einsum('jaa->ja', L)).sum())


def known_covariance(covariance: FloatArray) -> FloatArray:
    """(..., 3, 3) [T^2] those of frames; identity where an axis is missing."""
    missing = np.isnan(covariance)
    return np.where(missing, np.eye(3), covariance) if missing.any() else covariance
