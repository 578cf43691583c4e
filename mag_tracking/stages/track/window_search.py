"""Searches of a window for vehicles without a track: samples, start hypotheses and their states."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import overlap, rotation_about_z
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.vehicles import RowVehicle
from mag_tracking.stages.track import initiation_vehicle
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.stages.track.steady_search import PathPrior, StartGrid, SteadySearch
from mag_tracking.units import NS

MIN_MOMENT = 1e-6
"""[A m^2] Minimum magnitude of a moment at which its direction is defined."""
OVERLAP_WIDTH, OVERHANG, DEPTH_STD = 1.5, 1.0, 1.0
"""[m] Lateral distance below which two vehicles overlap, minimum longitudinal gap between their
rows of dipoles, and standard deviation of the overlap depth due to uncertain paths."""
MAX_SAMPLES = 320
"""Maximum number of samples of a search; windows with more are decimated."""
KNOWN_STD, KNOWN_MOMENT_RATIO = 0.7, 0.3
"""[m], [m/s] Std of known positions and velocities, and relative std of known moments."""


@dataclass(frozen=True)
class VehicleState:
    """Conversion of straight paths (`PATH` of `steady_pass`) to states of `RowVehicle`."""

    settings: initiation_vehicle.VehicleSettings
    network: SensorNetwork
    background_std: float
    """[T] Standard deviation of each background."""

    @cached_property
    def _model(self) -> RowVehicle:
        """Vehicle model of the settings."""
        return initiation_vehicle.vehicle_model(self.settings, self.network)

    @property
    def length_column(self) -> int | None:
        """Column of the length in the state of a vehicle; None if all vehicles are points."""
        return 9 + 3 * self._model.n_dipoles if self._model.n_dipoles > 1 else None

    def prior(self, theta: FloatArray, moments: FloatArray, t: float, kind: int, label: int
              ) -> tuple[FloatArray, FloatArray]:
        """Mean (n_t,), on a path `theta` (7,) at time `t` [s] and with the direction of `moments`
        (k, 3) [A m², world frame], and covariance (n_t, n_t) of an arriving vehicle; all else as at
        the start of a track."""
        s = self.settings
        R = rotation_about_z(float(np.deg2rad(s.arrival_headings_deg[label])))
        total = moments.sum(axis=0)
        mean = s.kinds[kind].moment * total / max(float(np.linalg.norm(total)), MIN_MOMENT)
        x = self.along(theta, mean[None], np.array([t]), kind)[0]
        x[2], x[5] = s.kinds[kind].height, 0.0
        if self.length_column is not None:
            x[self.length_column] = s.kinds[kind].length
        return x, initiation_vehicle.starting_covariance(s, kind, R, float(theta[3]))

    def along(self, theta: FloatArray, moments: FloatArray, times: FloatArray, kind: int
              ) -> FloatArray:
        """States (n, n_t) at `times` [s] on a straight path `theta` (7,), for a row of dipoles with
        `moments` (k, 3) from the tail to the head, A m², world frame."""
        d, s = self._model.n_dipoles, self.settings
        heading, length = float(theta[4]), float(theta[6])
        R = rotation_about_z(heading)
        soft_D = initiation_vehicle.soft_iron(s, kind)
        x = np.zeros((len(times), len(self._model.state_names)))
        velocity = np.array([theta[3] * np.cos(heading), theta[3] * np.sin(heading), theta[5]])
        x[:, :3], x[:, 3:6] = theta[:3] + times[:, None] * velocity, velocity
        ordered = moments[::-1] if length < 0.0 else moments
        is_point = s.kinds[kind].length_std == 0.0
        dipole_moments = np.tile(moments.sum(axis=0) / d, (d, 1)) if is_point \
            else _resampled(ordered, d)
        induced = soft_D * self._model.field_strength
        x[:, 6:6 + 3 * d] = (dipole_moments @ R - induced @ R / d).ravel()
        x[:, 6 + 3 * d:9 + 3 * d] = soft_D
        if d > 1:
            x[:, 9 + 3 * d] = s.kinds[kind].length if is_point else abs(length)
        return x

    def hard_moments(self, x: FloatArray) -> FloatArray:
        """Hard iron moments (d, 3) of a state `x` (n_t,), A m², vehicle frame."""
        return x[6:6 + 3 * self._model.n_dipoles].reshape(-1, 3)

    def turning(self, x: FloatArray, P: FloatArray, target: int) -> FloatArray | None:
        """Return `P` with one target's initial turn-rate variance; None if disabled."""
        if not self._model.turn_acceleration:
            return None
        n = len(self._model.state_names)
        first, w = target * n, (target + 1) * n - 1
        out = P.copy()
        out[w, w] = initiation_vehicle.START_TURN_RATIO**2 * self._model.turn_variance(
            np.hypot(x[first + 3], x[first + 4]))
        return out


def _resampled(moments: FloatArray, d: int) -> FloatArray:
    """Resample `moments` (k, 3) to `d` dipoles (d, 3) with the same total and centroid."""
    if len(moments) == 1 or d == 1:
        return np.tile(moments.sum(axis=0) / d, (d, 1))
    coordinates = np.linspace(0.0, d - 1.0, len(moments))
    weights = np.maximum(1.0 - np.abs(coordinates - np.arange(d)[:, None]), 0.0)
    return weights @ moments


@dataclass(frozen=True)
class PathHypothesis:
    """A hypothesis of several vehicles, with the path along which it is linearised."""

    x: FloatArray
    """(n_x,) State at the start of the window."""
    P: FloatArray
    """(n_x, n_x) Covariance at the start of the window."""
    path: FloatArray
    """(n, n_x) States at the frames of the window."""
    label: tuple[int, ...]
    """Index of the arrival direction of each vehicle."""
    kind: tuple[int, ...]
    log_w: float


@dataclass(frozen=True)
class WindowStart(PathHypothesis):
    """Hypothesis of known and new vehicles, at the start of a window."""

    new: range
    """Indices of the new vehicles, which are the last ones."""
    replaced: int | None
    """As in `JointExplanation`."""


@dataclass(frozen=True)
class KnownVehicles(PathHypothesis):
    """Hypothesis of the known vehicles in a search for new vehicles."""

    filter: BankFilter | None
    """Filter for this number of vehicles; None if no vehicle is known."""


def inserted(P: FloatArray, block: FloatArray, at: int) -> FloatArray:
    """Covariance (n + k, n + k) with an independent `block` (k, k) inserted into `P` at `at`."""
    n, k = len(P), len(block)
    rows = np.append(np.arange(at), np.arange(at + k, n + k))
    out = np.zeros((n + k, n + k))
    out[rows[:, None], rows] = P
    out[at:at + k, at:at + k] = block
    return out


def labels_of(labels: Sequence[tuple[int, ...]]) -> IntArray:
    """Labels of each vehicle and hypothesis in the shape of `FilterBank`, (n,) or (n, m)."""
    out = np.array(labels)
    return out[:, 0].copy() if out.shape[1] == 1 else out


def overlap_depth(path: FloatArray, n_one: int, n_targets: int, length_column: int | None) -> float:
    """Maximum depth [m] by which two vehicles overlap along a joint path (n, n_x)."""
    x = path[:, :n_one * n_targets].reshape(len(path), n_targets, n_one)
    depth = 0.0
    for i in range(n_targets):
        for k in range(i):
            gap = OVERHANG + (0.0 if length_column is None else
                              0.5 * (np.abs(x[:, i, length_column])
                                     + np.abs(x[:, k, length_column])))
            pair = x[:, [i, k]].swapaxes(0, 1)
            depth = max(depth, float(overlap(
                pair[:, :, :2], pair[:, :, 3:5], gap, OVERLAP_WIDTH).max()))
    return depth


class WindowSearch:
    """Samples of a window for searches for vehicles; `times` (n,) [s] end with zero."""

    def __init__(self, window: Window, vehicles: VehicleState) -> None:
        network, frames = vehicles.network, window.frames
        self._window, self._vehicles = window, vehicles
        self.times: FloatArray = np.array([(f.stamp_ns - frames[-1].stamp_ns) / NS
                                           for f in frames])
        step = -(-len(frames) * len(network) // MAX_SAMPLES)
        self._frame_indices = np.arange(len(frames))[::-1][::step][::-1]
        self.prior = PathPrior.of(vehicles.settings, network)
        self.samples = PassSamples.of(network, [frames[k] for k in self._frame_indices],
                                      frames[-1].stamp_ns, len(network))

    @cached_property
    def grid(self) -> StartGrid:
        """Grid of start paths for the searches in this window."""
        return StartGrid(self.samples, self.prior,
                         self.prior.starts(self._vehicles.settings, self._vehicles.network))

    def beside(self, known: KnownVehicles) -> SteadySearch:
        """Search for a vehicle in addition to known vehicles."""
        samples, backgrounds = self.samples, \
            self._vehicles.background_std * self.samples.backgrounds
        if known.filter is None:
            return SteadySearch(samples, self.prior, np.zeros(len(samples.y)), backgrounds)
        path, t = known.path[self._frame_indices], self.times[self._frame_indices]
        n, kind = len(path), np.array([known.kind])
        fields = [known.filter.fields_at(path[k], kind, self._window.frames[i],
                                         self._window.intervals[i])
                  for k, i in enumerate(self._frame_indices.tolist())]
        h, H = (np.array(part) for part in zip(*fields, strict=True))
        W = samples.M @ np.swapaxes(
            np.tile(self._vehicles.network.R_sw[samples.compared], (n, 1, 1)), 1, 2)
        h = h[:, samples.compared].reshape(-1, 3)
        columns = self._error_columns(H, path[-1], t, known.filter.observation.n_one)
        columns = columns[:, samples.compared].reshape(len(W), 3, -1)
        return SteadySearch(samples, self.prior, np.einsum('nij,nj->ni', W, h).ravel(),
                            np.hstack([backgrounds, (W @ columns).reshape(3 * len(W), -1)]))

    def _error_columns(self, H: FloatArray, x: FloatArray, t: FloatArray, n_one: int) -> FloatArray:
        """Field errors (n, n_sensors, 3, q) due to one std of each position, velocity or moment of
        the known vehicles, from the derivatives `H` (n, n_sensors, 3, n_t) of the fields at times
        `t` (n,) [s] relative to the end of the path, and the state `x` (n_x,) there."""
        out = []
        for first in range(0, H.shape[-1], n_one):
            H_one = H[..., first:first + n_one]
            H_velocity = H_one[..., 3:6] + t[:, None, None, None] * H_one[..., :3]
            hard = self._vehicles.hard_moments(x[first:first + n_one])
            H_moment = H_one[..., 6:6 + hard.size].reshape(*H_one.shape[:3], -1, 3).mean(axis=3)
            magnitude = float(np.linalg.norm(hard.sum(axis=0)))
            out += [KNOWN_STD * H_one[..., :3], KNOWN_STD * H_velocity,
                    KNOWN_MOMENT_RATIO * magnitude * H_moment]
        return np.concatenate(out, axis=3)
