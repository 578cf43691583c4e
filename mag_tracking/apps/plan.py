"""Prediction of accuracy and coverage of a sensor network before its installation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from mag_tracking.analysis.placement import (
    DIRECTIONS,
    STATES,
    PlannedTarget,
    Sampling,
    bounds_of,
    detection_probabilities,
    pass_fields,
    pass_information,
)
from mag_tracking.arrays import FloatArray
from mag_tracking.inference.crlb import Observability, observability, path_bound, snr_range
from mag_tracking.inference.detection_theory import energy_threshold, missed_detection_probability
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import constant_velocity, integrator_noise
from mag_tracking.pipeline import Settings
from mag_tracking.stages.track.settings import acceleration_density

MAX_FRAMES = 1000
"""Maximum number of frames per pass in the calculation of the miss probability. Additional frames
of slower passes hardly change this probability."""

Area: TypeAlias = tuple[float, float, float, float]
"""Rectangle (x0, y0, x1, y1) [m]."""

GOOD_PD = 0.9
"""Detection probability per frame at which a target counts as detectable."""


@dataclass(frozen=True)
class Lane:
    """Straight lane, with Cramér-Rao bounds and detection probabilities along the lane."""

    name: str
    """Name in messages and figures."""
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
    target: PlannedTarget
    """Assumed target."""
    sampling: Sampling
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


def detection_range(target: PlannedTarget, noise_std: float, n_axes: int,
                    false_alarm: float) -> float:
    """Approximate range [m] at which one sensor detects half of the targets in one frame, [T10]_
    eq. (5.20).

    `noise_std` [T] is that of one axis. The signal energy is averaged over all directions of the
    moment: twice the energy at a point perpendicular to the axis of the dipole.
    """
    return float(snr_range(np.sqrt(2.0) * target.moment, noise_std,
                           energy_threshold(false_alarm, n_axes)))


def compute_plan(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                 lanes: Sequence[tuple[str, float, float]], area: Area, settings: Settings,
                 clearance: float = 0.0, n_grid: int = 41,
                 progress: Callable[[int], object] | None = None) -> Plan:
    """Compute bounds, detection probabilities and the best position of an additional sensor.

    Parameters
    ----------
    lanes : (name, heading [rad], lateral offset [m] from the centre of the sensors, positive to the
        left of the heading)
    area : (x0, y0, x1, y1), m, of the maps
    clearance : minimum distance of an additional sensor from a lane, m
    n_grid : number of points along the longer side of the maps
    progress : called with 1 whenever one of the `n_parts` parts is completed
    """
    report_part = progress or (lambda n: None)
    x, y = _grid(area, n_grid)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    bounds = []
    for heading in sorted({heading % np.pi for _, heading, _ in lanes}):
        bounds.append(_position_bounds(network, target, sampling, points, heading))
        report_part(1)
    detect = settings.detect
    probability = detection_probabilities(
        network.positions, network.R_sw, target, sampling, points, detect.false_alarm_probability,
        detect.background_std)
    report_part(1)
    planned = tuple(_lane(network, target, sampling, *lane, area, settings) for lane in lanes)
    report_part(1)
    # The effect of the additional sensor is evaluated where the lanes are near the network.
    half_length = 0.5 * max(np.ptp(network.positions[:, :2], axis=0).max(), 8.0 * target.height)
    near = [(lane.heading, lane.points[np.abs(lane.along) <= half_length][::4]) for lane in planned]
    coarse_x, coarse_y = _grid(area, max(11, n_grid // 2))
    sites = np.stack(np.meshgrid(coarse_x, coarse_y), axis=-1).reshape(-1, 2)
    is_allowed = np.all([_lane_distances(lane, sites) >= clearance for lane in planned], axis=0)
    median_bound = np.full(len(sites), np.nan)
    without, with_sensor = _added_sensor_bounds(network, target, sampling, near, sites[is_allowed])
    median_bound[is_allowed] = with_sensor
    report_part(1)
    best_index = int(np.nanargmin(median_bound)) if is_allowed.any() else 0
    lane_observability, closest_bounds = _closest_point_bounds(
        network, target, sampling, planned[0], half_length)
    shape = len(coarse_y), len(coarse_x)
    return Plan(
        network, target, sampling, x, y,
        np.median(np.concatenate(bounds, axis=1), axis=1).reshape(len(y), len(x)),
        probability.mean(axis=1).reshape(len(y), len(x)), planned,
        median_bound.reshape(shape), without,
        (float(coarse_x[best_index % shape[1]]), float(coarse_y[best_index // shape[1]])),
        lane_observability, closest_bounds,
        _miss_probabilities(network, target, sampling, planned[0], area, settings))


def _position_bounds(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                     points: FloatArray, heading: float) -> FloatArray:
    """Position bounds (n, n_directions) [m] of passes through points, per moment direction."""
    J = pass_information(network.positions, network.R_sw, target, sampling, points, heading)
    return bounds_of(J.sum(axis=2), target.prior())[..., 0]


def _closest_point_bounds(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                          lane: Lane, distance_scale: float,
                          ) -> tuple[Observability, dict[str, FloatArray]]:
    """Compute `Plan.observability`, with positions in units of `distance_scale` [m], and
    `Plan.bounds_at_closest`."""
    closest = lane.points[np.argmin(np.abs(lane.along))][None]
    J = pass_information(network.positions, network.R_sw, target, sampling, closest,
                         lane.heading)[0].sum(axis=1)
    scale = np.repeat([max(distance_scale, 1e-3), target.speed, target.moment], 3)
    return (observability(J[3], STATES, scale),
            {'with prior': np.median(bounds_of(J, target.prior()), axis=0),
             'without prior': np.median(bounds_of(J, np.zeros((9, 9))), axis=0)})


def _lane_distances(lane: Lane, points: FloatArray) -> FloatArray:
    """Distances (n,) [m] of `points` (n, 2) from the centre line of a lane."""
    u = lane.points[-1] - lane.points[0]
    r = points - lane.points[0]
    distance: FloatArray = np.abs(u[0] * r[:, 1] - u[1] * r[:, 0]) / np.hypot(*u)
    return distance


def n_parts(lanes: Sequence[tuple[str, float, float]]) -> int:
    """Number of times that `compute_plan` calls `progress`."""
    return len({heading % np.pi for _, heading, _ in lanes}) + 3


def _grid(area: Area, n: int) -> tuple[FloatArray, FloatArray]:
    """Coordinates (x, y) of a map with square cells and `n` points along the longer side."""
    x0, y0, x1, y1 = area
    cell = max(x1 - x0, y1 - y0) / (n - 1)
    return (np.linspace(x0, x1, max(2, int(round((x1 - x0) / cell)) + 1), dtype=float),
            np.linspace(y0, y1, max(2, int(round((y1 - y0) / cell)) + 1), dtype=float))


def _lane(network: SensorNetwork, target: PlannedTarget, sampling: Sampling, name: str,
          heading: float, offset: float, area: Area, settings: Settings) -> Lane:
    """Compute bounds and detection probabilities along one lane."""
    u = np.array([np.cos(heading), np.sin(heading)])
    half_length = 0.5 * np.hypot(area[2] - area[0], area[3] - area[1])
    n = int(np.clip(half_length / (target.speed * sampling.period), 10, 60))
    along = np.linspace(-half_length, half_length, 2 * n + 1)
    points = network.centre[:2] + offset * np.array([-u[1], u[0]]) + along[:, None] * u
    sensor_poses = network.positions, network.R_sw
    J = pass_information(*sensor_poses, target, sampling, points, heading).sum(axis=2)
    detect = settings.detect
    probability = detection_probabilities(*sensor_poses, target, sampling, points,
                                          detect.false_alarm_probability, detect.background_std)
    return Lane(name, heading, along, points,
                np.median(bounds_of(J, target.prior()), axis=1),
                _filter_bound(network, target, sampling, points, heading, settings),
                probability.mean(axis=1))


def _filter_bound(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                  points: FloatArray, heading: float, settings: Settings) -> FloatArray:
    """Position bound (n,) [m], at each point of a lane, of a filter that starts at the first point.

    The filter uses the motion model of the tracker and estimates the backgrounds. The bound is the
    median over the directions of the moment.
    """
    n_sensors, dt = len(network), np.hypot(*(points[1] - points[0])) / target.speed
    n_samples = dt / sampling.period
    frame_sampling = Sampling(sampling.period, sampling.noise_std, half_window=0.0)
    n_x = 9 + 3 * n_sensors
    F, Q, P0 = np.eye(n_x), np.zeros((n_x, n_x)), np.zeros((n_x, n_x))
    F[:6, :6] = constant_velocity(dt)
    Q[:6, :6] = integrator_noise(dt, acceleration_density(settings.track))
    information = np.diagonal(target.prior())[[2, 5]]
    prior_std = np.array([1.0, 1.0, 1.0, target.speed, target.speed, target.speed])
    prior_std[:3] *= np.hypot(*(points[-1] - points[0]))
    prior_std[[2, 5]] = np.where(
        information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-30)), prior_std[[2, 5]])
    P0[range(6), range(6)] = prior_std**2
    P0[range(6, 9), range(6, 9)] = target.moment**2 / 3.0
    P0[range(9, n_x), range(9, n_x)] = min(sampling.background_std, 1e-6)**2
    _, h, H = zip(*pass_fields(network.positions, network.R_sw, target, frame_sampling, points,
                               heading), strict=True)
    h, H = np.concatenate(h), np.concatenate(H)
    std = np.empty((len(points), len(DIRECTIONS)))
    backgrounds = np.broadcast_to(np.eye(3 * n_sensors).reshape(n_sensors, 3, -1),
                                  (len(points), n_sensors, 3, 3 * n_sensors))
    for d in range(len(DIRECTIONS)):
        variance = (np.square(sampling.noise_std) + sampling.field_error**2 * np.square(
            h[:, d, 0]).sum(axis=-1)) / n_samples
        P = path_bound(F, Q, np.concatenate([H[:, d, 0], backgrounds], axis=-1),
                       variance[..., None, None] * np.eye(3), P0)
        std[:, d] = np.sqrt(P[:, 0, 0] + P[:, 1, 1])
    bound: FloatArray = np.median(std, axis=1)
    return bound


def _added_sensor_bounds(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                         near_lanes: Sequence[tuple[float, FloatArray]],
                         candidates: FloatArray) -> tuple[float, FloatArray]:
    """Median position bound [m] without and with an additional sensor at each of the candidates.

    If `near_lanes` or `candidates` is empty, the results are NaN and an empty array.
    """
    height = network.positions[:, 2].mean()
    candidate_positions = np.column_stack([candidates, np.full(len(candidates), height)])
    upright = np.tile(np.eye(3), (len(candidates), 1, 1))
    added_sampling = replace(sampling, noise_std=float(np.median(sampling.noise_std)))
    prior = target.prior()
    bounds_without, bounds_with = [], []
    for heading, points in near_lanes:
        if not len(candidates):
            continue
        J = pass_information(network.positions, network.R_sw, target, sampling, points,
                             heading).sum(axis=2)
        bounds_without.append(bounds_of(J, prior)[..., 0].ravel())
        added_information = pass_information(candidate_positions, upright, target, added_sampling,
                                             points, heading)
        bounds_with.append(bounds_of(J[:, :, None] + added_information, prior)[..., 0].reshape(
            -1, len(candidates)))
    if not bounds_without:
        return float('nan'), np.zeros(0)
    return (float(np.median(np.concatenate(bounds_without))),
            np.median(np.concatenate(bounds_with), axis=0))


def _miss_probabilities(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                        lane: Lane, area: Area, settings: Settings) -> FloatArray:
    """Compute `Plan.miss_curve`: a pass is missed unless `detect.onset_frames` consecutive frames
    detect the target."""
    half_length = 0.5 * max(area[2] - area[0], area[3] - area[1])
    offsets = np.linspace(0.0, 2.0 * half_length, 25)
    u = np.array([np.cos(lane.heading), np.sin(lane.heading)])
    n = int(np.clip(4.0 * half_length / (target.speed * sampling.period), 1, MAX_FRAMES))
    along = np.linspace(-2.0 * half_length, 2.0 * half_length, n)[:, None]
    detect, rows = settings.detect, []
    for offset in offsets:
        points = network.centre[:2] + offset * np.array([-u[1], u[0]]) + along * u
        probability = detection_probabilities(
            network.positions, network.R_sw, target, sampling, points,
            detect.false_alarm_probability, detect.background_std)
        rows.append((offset, float(np.mean(
            missed_detection_probability(probability, detect.onset_frames)))))
    return np.array(rows)
