"""Prediction of accuracy and coverage of a sensor network before its installation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.analysis import placement
from mag_tracking.apps.plan_inputs import Area, LaneLine, plan_inputs
from mag_tracking.apps.readings import network_of
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.crlb import Observability, observability, path_bound
from mag_tracking.inference.detection_theory import missed_detection_probability
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import constant_velocity, integrator_noise
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.stages.track.settings import acceleration_density

MAX_FRAMES = 1000
"""Maximum number of frames per pass in the calculation of the miss probability. Additional frames
of slower passes hardly change this probability."""
GOOD_PD = 0.9
"""Detection probability per frame at which a target counts as detectable."""


@dataclass(frozen=True)
class Lane:
    """Straight lane, with Cramér-Rao bounds and detection probabilities along the lane."""

    name: str
    heading: float
    """Heading, anticlockwise from x [rad]."""
    along: FloatArray
    """(n,) m, signed distance from the point nearest to the centre of the sensors."""
    points: FloatArray
    """(n, 2) m, points of the lane, world frame."""
    pass_std: FloatArray
    """(n, 3) m, m/s, A m²: bounds of position, velocity and moment from the whole pass; median over
    the directions of the moment."""
    filter_std: FloatArray
    """(n,) m, position bound of a filter that has processed the measurements up to the point."""
    detection: FloatArray
    """(n,) probability that a frame detects the target; mean over the directions of the moment."""


@dataclass(frozen=True)
class Plan:
    """Predicted performance of a network; maps are indexed [y, x]."""

    network: SensorNetwork
    """Planned network."""
    target: placement.PlannedTarget
    """Assumed target."""
    sampling: placement.Sampling
    """Noise and sampling of the sensors."""
    x: FloatArray
    """(nx,) m, coordinates of the maps."""
    y: FloatArray
    """(ny,) m, coordinates of the maps."""
    position_std: FloatArray
    """(ny, nx) m, bound of the position from a whole pass through the point; median over headings
    and directions of the moment."""
    detection: FloatArray
    """(ny, nx) probability that one frame detects the target at the point."""
    lanes: tuple[Lane, ...]
    """Lanes through the network."""
    std_with_added_sensor: FloatArray
    """(my, mx) m, coarser map of the median position bound on the lanes near the network if a
    sensor is added at the point; NaN where no sensor is allowed."""
    std_without_added_sensor: float
    """Median position bound on the lanes near the network without an additional sensor [m]; NaN if
    no additional sensor is allowed."""
    best_position: tuple[float, float]
    """Best position of the additional sensor (x, y) [m]; not valid if no sensor is allowed."""
    observability: Observability
    """Observability at the closest point of the first lane, for one direction of the moment,
    without priors."""
    bounds_at_closest: dict[str, FloatArray]
    """{'with prior' or 'without prior': (3,) bounds of position [m], velocity [m/s] and moment
    [A m²]} at the closest point of the first lane; medians over the directions of the moment."""
    miss_curve: FloatArray
    """(n, 2) lateral distance [m] of a pass with the heading of the first lane, and probability
    that the pass is missed."""


def plan(network: SensorNetwork | str | PathLike[str], target: str | None = None, *,
         moment: float | None = None, height: float | None = None, speed: float = 10.0,
         heading: Sequence[float] | None = None, offset: Sequence[float] | None = None,
         noise_std: float | None = None, rate: float = 100.0, field_error: float | None = None,
         area: Sequence[float] | None = None, clearance: float | None = None, grid: int = 41,
         settings: Mapping[str, Any] | None = None) -> Plan:
    """Predict accuracy, detection and the best position of an additional sensor.

    Parameters
    ----------
    network : SensorNetwork or path of a network file
    target : str, optional
        Kind of vehicle ('small', 'car' or 'truck'; default: 'car'), whose moment and height are in
        the settings; or 'magnet', which requires `moment` and `height`.
    moment : float, A m², optional
        Magnitude of the moment; requires `height`.
    height : float, m, optional
        Height of the magnetic centre, z in the frame of the network.
    speed : float, m/s
        Speed of the target.
    heading : sequence of float, deg, optional
        Heading of each lane, measured anticlockwise from x; default: the arrival directions in the
        settings.
    offset : sequence of float, m, optional
        Lateral offset of each lane from the centre of the sensors, positive to the left of the
        heading; default: 0.
    noise_std : float, T, optional
        Noise of one sample; default: the noise in the network file, or 12 nT.
    rate : float, Hz
        Sample rate of each sensor.
    field_error : float, optional
        Relative error of the field; default: `track.field_error`.
    area : (x0, y0, x1, y1), m, optional
        Area of the maps; default: the bounding box of the sensors, extended by the range at which a
        sensor detects half of the targets.
    clearance : float, m, optional
        Minimum distance of an additional sensor from a lane; default: 2, or 0 if
        `moment` is given.
    grid : int
        Number of points along the longer side of the maps.
    settings : {name: value}, optional
        Settings that differ from the defaults of the target.

    Returns
    -------
    Plan

    Raises
    ------
    SettingsError
        If an input is out of range; the message begins with its name.
    NetworkError
        If the network file is invalid.
    """
    network = network_of(network)
    full_settings = settings_for('magnet' if target == 'magnet' else 'vehicle', settings)
    return compute_plan(*plan_inputs(
        network, full_settings, target, moment, height, speed, heading, offset, noise_std, rate,
        field_error, area, clearance, grid))


def n_parts(lanes: Sequence[LaneLine]) -> int:
    """Number of times that `compute_plan` calls `progress`."""
    return len(_directions(lanes)) + 3


def _directions(lanes: Sequence[LaneLine]) -> list[float]:
    """Headings of the lanes, modulo 180 degrees [rad]."""
    return sorted({heading % np.pi for _, heading, _ in lanes})


def compute_plan(network: SensorNetwork, target: placement.PlannedTarget,
                 sampling: placement.Sampling, lanes: Sequence[LaneLine], area: Area,
                 settings: Settings,
                 clearance: float = 0.0, n_grid: int = 41,
                 progress: Callable[[int], object] | None = None) -> Plan:
    """Compute a plan; `clearance` [m] is the distance of an additional sensor from a lane, and
    `progress` is called with 1 for each of the `n_parts`."""
    report_part = progress or (lambda n: None)
    passes = _Passes(network, target, sampling, settings)
    x, y, points = _grid(area, n_grid)
    bounds = []
    for heading in _directions(lanes):
        bounds.append(passes.bounds(points, heading)[..., 0])
        report_part(1)
    probability = passes.detection(points)
    report_part(1)
    planned = tuple(passes.lane(*lane, area) for lane in lanes)
    report_part(1)
    # The effect of the additional sensor is evaluated where the lanes are near the network.
    half_length = 0.5 * max(np.ptp(network.positions[:, :2], axis=0).max(), 8.0 * target.height)
    near = [(lane.heading, lane.points[np.abs(lane.along) <= half_length][::4]) for lane in planned]
    coarse_x, coarse_y, sites = _grid(area, max(11, n_grid // 2))
    is_allowed = np.all([_lane_distances(lane, sites) >= clearance for lane in planned], axis=0)
    median_bound = np.full(len(sites), np.nan)
    without, median_bound[is_allowed] = passes.added_sensor_bounds(near, sites[is_allowed])
    report_part(1)
    best_x, best_y = sites[np.nanargmin(median_bound) if is_allowed.any() else 0].tolist()
    return Plan(
        network, target, sampling, x, y,
        np.median(np.concatenate(bounds, axis=1), axis=1).reshape(len(y), len(x)),
        probability.mean(axis=1).reshape(len(y), len(x)), planned,
        median_bound.reshape(len(coarse_y), len(coarse_x)), without, (best_x, best_y),
        *passes.closest_point(planned[0], half_length), passes.miss_curve(planned[0], area))


def _lane_distances(lane: Lane, points: FloatArray) -> FloatArray:
    """Distances (n,) [m] of `points` (n, 2) from the centre line of a lane."""
    u = lane.points[-1] - lane.points[0]
    r = points - lane.points[0]
    distance: FloatArray = np.abs(u[0] * r[:, 1] - u[1] * r[:, 0]) / np.hypot(*u)
    return distance


def _grid(area: Area, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coordinates (nx,), (ny,) and points (ny nx, 2) of a map with square cells."""
    x0, y0, x1, y1 = area
    cell = max(x1 - x0, y1 - y0) / (n - 1)
    x, y = (np.linspace(low, high, max(2, int(round((high - low) / cell)) + 1), dtype=float)
            for low, high in ((x0, x1), (y0, y1)))
    return x, y, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


class _Passes:
    """Passes of a target over a network, for all directions of its moment."""

    def __init__(self, network: SensorNetwork, target: placement.PlannedTarget,
                 sampling: placement.Sampling, settings: Settings) -> None:
        self.network, self.target, self.sampling, self.settings = (
            network, target, sampling, settings)
        self.poses, self.prior = (network.positions, network.R_sw), target.prior()

    def information(self, points: FloatArray, heading: float) -> FloatArray:
        """Information (n, 7, 9, 9) of all sensors about passes through points (n, 2)."""
        return np.asarray(placement.pass_information(*self.poses, self.target, self.sampling,
                                                     points, heading).sum(axis=2))

    def bounds(self, points: FloatArray, heading: float) -> FloatArray:
        """Bounds (n, 7, 3) of position, velocity and moment of passes through points (n, 2)."""
        return placement.bounds_of(self.information(points, heading), self.prior)

    def detection(self, points: FloatArray) -> FloatArray:
        """Detection probability (n, 7) of one frame with the target at points (n, 2)."""
        detect = self.settings.detect
        return placement.detection_probabilities(
            *self.poses, self.target, self.sampling, points, detect.false_alarm_probability,
            detect.background_std)

    def points(self, heading: float, offset: float, along: FloatArray) -> FloatArray:
        """Points (n, 2) [m] of a lane at the distances `along` (n,) from the centre."""
        u = np.array([np.cos(heading), np.sin(heading)])
        points: FloatArray = self.network.centre[:2] + offset * np.array(
            [-u[1], u[0]]) + along[:, None] * u
        return points

    def lane(self, name: str, heading: float, offset: float, area: Area) -> Lane:
        half_length = 0.5 * np.hypot(area[2] - area[0], area[3] - area[1])
        n = int(np.clip(half_length / (self.target.speed * self.sampling.period), 10, 60))
        along = np.linspace(-half_length, half_length, 2 * n + 1)
        points = self.points(heading, offset, along)
        return Lane(name, heading, along, points, np.median(self.bounds(points, heading), axis=1),
                    self._filter_bound(points, heading), self.detection(points).mean(axis=1))

    def _filter_bound(self, points: FloatArray, heading: float) -> FloatArray:
        """Position bound (n,) [m] on a lane of a filter that starts at its first point, with the
        motion model of the tracker and unknown backgrounds; median over the directions of the
        moment."""
        target, sampling, n_sensors = self.target, self.sampling, len(self.network)
        dt = np.hypot(*(points[1] - points[0])) / target.speed
        n_x = 9 + 3 * n_sensors
        F, Q = np.eye(n_x), np.zeros((n_x, n_x))
        F[:6, :6] = constant_velocity(dt)
        Q[:6, :6] = integrator_noise(dt, acceleration_density(self.settings.track))
        information = np.diagonal(self.prior)[[2, 5]]
        prior_std = np.array([1.0, 1.0, 1.0, target.speed, target.speed, target.speed])
        prior_std[:3] *= np.hypot(*(points[-1] - points[0]))
        prior_std[[2, 5]] = np.where(
            information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-30)), prior_std[[2, 5]])
        P0 = np.diag(np.concatenate([
            prior_std**2, np.full(3, target.moment**2 / 3.0),
            np.full(3 * n_sensors, min(sampling.background_std, 1e-6)**2)]))
        instant = placement.Sampling(sampling.period, sampling.noise_std, half_window=0.0)
        _, h, H = zip(*placement.pass_fields(*self.poses, target, instant, points, heading),
                      strict=True)
        h, H = np.concatenate(h), np.concatenate(H)
        std = np.empty((len(points), len(placement.DIRECTIONS)))
        backgrounds = np.broadcast_to(np.eye(3 * n_sensors).reshape(n_sensors, 3, -1),
                                      (len(points), n_sensors, 3, 3 * n_sensors))
        for d in range(len(placement.DIRECTIONS)):
            variance = (np.square(sampling.noise_std) + sampling.field_error**2 * np.square(
                h[:, d, 0]).sum(axis=-1)) / (dt / sampling.period)
            P = path_bound(F, Q, np.concatenate([H[:, d, 0], backgrounds], axis=-1),
                           variance[..., None, None] * np.eye(3), P0)
            std[:, d] = np.sqrt(P[:, 0, 0] + P[:, 1, 1])
        return np.asarray(np.median(std, axis=1))

    def added_sensor_bounds(self, near_lanes: Sequence[tuple[float, FloatArray]],
                            candidates: FloatArray) -> tuple[float, FloatArray]:
        """Median position bound [m] on lanes (heading, points) without and with an additional
        sensor at each candidate; NaN and an empty array without candidates."""
        n = len(candidates)
        if not n:
            return float('nan'), np.zeros(0)
        added = np.column_stack([candidates, np.full(n, self.network.positions[:, 2].mean())])
        sampling = replace(self.sampling, noise_std=float(np.median(self.sampling.noise_std)))
        bounds_without, bounds_with = [], []
        for heading, points in near_lanes:
            J = self.information(points, heading)
            bounds_without.append(placement.bounds_of(J, self.prior)[..., 0].ravel())
            added_information = placement.pass_information(
                added, np.tile(np.eye(3), (n, 1, 1)), self.target, sampling, points, heading)
            bounds_with.append(placement.bounds_of(J[:, :, None] + added_information, self.prior)[
                ..., 0].reshape(-1, n))
        return (float(np.median(np.concatenate(bounds_without))),
                np.median(np.concatenate(bounds_with), axis=0))

    def closest_point(self, lane: Lane, distance_scale: float
                      ) -> tuple[Observability, dict[str, FloatArray]]:
        """Compute `Plan.observability`, scaled by `distance_scale` [m], and `bounds_at_closest`."""
        J = self.information(lane.points[np.argmin(np.abs(lane.along))][None], lane.heading)[0]
        scale = np.repeat([max(distance_scale, 1e-3), self.target.speed, self.target.moment], 3)
        return (observability(J[3], placement.STATES, scale),
                {'with prior': np.median(placement.bounds_of(J, self.prior), axis=0),
                 'without prior': np.median(placement.bounds_of(J, np.zeros((9, 9))), axis=0)})

    def miss_curve(self, lane: Lane, area: Area) -> FloatArray:
        """Compute `Plan.miss_curve`: `detect.onset_frames` consecutive frames must detect."""
        half_length = 0.5 * max(area[2] - area[0], area[3] - area[1])
        n = int(np.clip(4.0 * half_length / (self.target.speed * self.sampling.period), 1,
                        MAX_FRAMES))
        along = np.linspace(-2.0 * half_length, 2.0 * half_length, n, dtype=np.float64)
        return np.array([(offset, float(np.mean(missed_detection_probability(
            self.detection(self.points(lane.heading, offset, along)),
            self.settings.detect.onset_frames))))
            for offset in np.linspace(0.0, 2.0 * half_length, 25)])
